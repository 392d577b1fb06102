//! A circuit breaker, which suspends calls to a server that keeps failing, or that refuses every call.
//!
//! Its state is in a watch channel of tokio, whose changes are atomic; it has no locks of its own.

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;

/// Passes calls until several in a row have failed (closed), then refuses calls for a while (open), then
/// passes one probe, whose outcome closes or opens it again (half-open).
#[derive(Debug)]
pub struct Breaker {
    failures: u32,
    open_for: Duration,
    state: watch::Sender<State>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    /// Calls pass. `failed` counts the last failures in a row.
    Closed { failed: u32 },
    /// Calls are refused until then.
    Open { until: Instant },
    /// A probe is in progress; other calls wait for its outcome.
    HalfOpen,
}

/// The breaker is open.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Open {
    /// Time until it passes a probe.
    pub wait: Duration,
}

/// What [`Breaker::admit`] does with a call.
enum Decision {
    Pass { probe: bool },
    Refuse(Open),
    Await,
}

impl Breaker {
    /// Creates a closed breaker that opens for `open_for` after `failures` failures in a row.
    pub fn new(failures: u32, open_for: Duration) -> Self {
        let state = watch::Sender::new(State::Closed { failed: 0 });
        Self { failures: failures.max(1), open_for, state }
    }

    /// Admits a call or refuses it. While a probe is in progress, waits for its outcome.
    pub async fn admit(&self) -> Result<Admission<'_>, Open> {
        let mut changes = self.state.subscribe();
        loop {
            match self.decide() {
                Decision::Pass { probe } => {
                    return Ok(Admission { breaker: self, probe, reported: false });
                }
                Decision::Refuse(open) => return Err(open),
                // Cannot fail, because the sender lives as long as `self`.
                Decision::Await => {
                    let _ = changes.wait_for(|state| *state != State::HalfOpen).await;
                }
            }
        }
    }

    /// Returns for how long calls are refused; `None` if they are not.
    pub fn open_for(&self) -> Option<Duration> {
        match *self.state.borrow() {
            State::Open { until } => {
                Some(until.saturating_duration_since(Instant::now())).filter(|wait| !wait.is_zero())
            }
            State::Closed { .. } | State::HalfOpen => None,
        }
    }

    /// Returns whether calls are refused at the moment.
    pub fn is_open(&self) -> bool {
        self.open_for().is_some()
    }

    fn decide(&self) -> Decision {
        let mut decision = Decision::Await;
        self.state.send_if_modified(|state| {
            let now = Instant::now();
            let (decided, next) = match *state {
                State::Closed { .. } => (Decision::Pass { probe: false }, *state),
                State::Open { until } if until > now => {
                    (Decision::Refuse(Open { wait: until - now }), *state)
                }
                State::Open { .. } => (Decision::Pass { probe: true }, State::HalfOpen),
                State::HalfOpen => (Decision::Await, *state),
            };
            decision = decided;
            let changed = next != *state;
            *state = next;
            changed
        });
        decision
    }

    fn record(&self, probe: bool, outcome: CallOutcome) {
        self.state.send_modify(|state| {
            let open = State::Open { until: Instant::now() + self.open_for };
            *state = match (*state, probe, outcome) {
                (State::HalfOpen, true, CallOutcome::Success) => State::Closed { failed: 0 },
                (State::HalfOpen, true, CallOutcome::Failure | CallOutcome::Refusal) => open,
                // The next call is the probe.
                (State::HalfOpen, true, CallOutcome::Unknown) => {
                    State::Open { until: Instant::now() }
                }
                (State::Closed { .. }, _, CallOutcome::Success) => State::Closed { failed: 0 },
                (State::Closed { .. }, _, CallOutcome::Refusal) => open,
                (State::Closed { failed }, _, CallOutcome::Failure)
                    if failed + 1 >= self.failures =>
                {
                    open
                }
                (State::Closed { failed }, _, CallOutcome::Failure) => {
                    State::Closed { failed: failed + 1 }
                }
                // A call from before the breaker opened says nothing about the server now.
                (unchanged, _, _) => unchanged,
            };
        });
    }
}

#[derive(Debug, Clone, Copy)]
enum CallOutcome {
    Success,
    Failure,
    /// The server refuses this call as it will all others.
    Refusal,
    /// The call was dropped.
    Unknown,
}

/// The permission to make one call, which reports the call's outcome to the breaker.
#[derive(Debug)]
pub struct Admission<'a> {
    breaker: &'a Breaker,
    probe: bool,
    reported: bool,
}

impl Admission<'_> {
    /// Reports that the server answered.
    pub fn succeeded(mut self) {
        self.report(CallOutcome::Success);
    }

    /// Reports that the server failed.
    pub fn failed(mut self) {
        self.report(CallOutcome::Failure);
    }

    /// Reports that the server refuses every call, and returns the time until the next try.
    pub fn refused(mut self) -> Duration {
        self.report(CallOutcome::Refusal);
        self.breaker.open_for().unwrap_or_default()
    }

    fn report(&mut self, outcome: CallOutcome) {
        self.reported = true;
        self.breaker.record(self.probe, outcome);
    }
}

impl Drop for Admission<'_> {
    fn drop(&mut self) {
        if !self.reported {
            self.report(CallOutcome::Unknown);
        }
    }
}

#[cfg(test)]
mod schedules;

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::poll;
    use std::pin::pin;

    const OPEN_FOR: Duration = Duration::from_secs(30);

    async fn opened() -> Breaker {
        let breaker = Breaker::new(2, OPEN_FOR);
        for _ in 0..2 {
            breaker.admit().await.unwrap().failed();
        }
        breaker
    }

    #[tokio::test(start_paused = true)]
    async fn failures_in_a_row_open_it_and_a_success_resets_the_count() {
        let breaker = Breaker::new(2, OPEN_FOR);
        breaker.admit().await.unwrap().failed();
        breaker.admit().await.unwrap().succeeded();
        breaker.admit().await.unwrap().failed();
        assert!(breaker.admit().await.is_ok());
        breaker.admit().await.unwrap().failed();
        assert_eq!(breaker.admit().await.unwrap_err(), Open { wait: OPEN_FOR });
        assert!(breaker.is_open());
    }

    #[tokio::test(start_paused = true)]
    async fn half_open_admits_one_probe_and_the_others_wait_for_it() {
        let breaker = opened().await;
        tokio::time::advance(OPEN_FOR).await;
        let probe = breaker.admit().await.unwrap();
        let mut other = pin!(breaker.admit());
        assert!(poll!(&mut other).is_pending());
        probe.succeeded();
        assert!(other.await.is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn a_refusal_of_every_call_opens_it_at_once() {
        let breaker = Breaker::new(100, OPEN_FOR);
        let (first, other) = (breaker.admit().await.unwrap(), breaker.admit().await.unwrap());
        assert_eq!(first.refused(), OPEN_FOR);
        // A call that was under way says nothing about the others.
        other.succeeded();
        assert_eq!(breaker.open_for(), Some(OPEN_FOR));
        tokio::time::advance(OPEN_FOR).await;
        assert_eq!(breaker.admit().await.unwrap().refused(), OPEN_FOR);
    }

    #[tokio::test(start_paused = true)]
    async fn a_failed_probe_opens_it_again() {
        let breaker = opened().await;
        tokio::time::advance(OPEN_FOR).await;
        breaker.admit().await.unwrap().failed();
        assert_eq!(breaker.admit().await.unwrap_err(), Open { wait: OPEN_FOR });
    }

    #[tokio::test(start_paused = true)]
    async fn after_a_dropped_probe_the_next_call_is_the_probe() {
        let breaker = opened().await;
        tokio::time::advance(OPEN_FOR).await;
        drop(breaker.admit().await.unwrap());
        assert!(breaker.admit().await.unwrap().probe);
    }
}
