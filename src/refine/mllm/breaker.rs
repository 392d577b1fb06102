//! A circuit breaker: a server that keeps failing is left alone for a while.

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;

/// Lets calls pass until so many fail in a row; then none for a while; then one, whose end decides.
#[derive(Debug)]
pub struct Breaker {
    failures: u32,
    open_for: Duration,
    state: watch::Sender<State>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    /// Calls pass; so many of the last ones failed.
    Closed { failed: u32 },
    /// No call passes until then.
    Open { until: Instant },
    /// One call has passed, to try.
    Probing,
}

/// No call passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Open {
    /// How long from now on.
    pub wait: Duration,
}

/// What [`Breaker::admit`] does with a call.
enum Verdict {
    Pass { probe: bool },
    Refuse(Open),
    Await,
}

impl Breaker {
    /// A closed breaker that opens for `open_for` after `failures` failures in a row.
    pub fn new(failures: u32, open_for: Duration) -> Self {
        let state = watch::Sender::new(State::Closed { failed: 0 });
        Self { failures: failures.max(1), open_for, state }
    }

    /// Asks to make a call. While another call tries the server, this one waits for how it ends.
    pub async fn admit(&self) -> Result<Admission<'_>, Open> {
        let mut changes = self.state.subscribe();
        loop {
            match self.decide() {
                Verdict::Pass { probe } => {
                    return Ok(Admission { breaker: self, probe, told: false });
                }
                Verdict::Refuse(open) => return Err(open),
                // The sender lives as long as `self`, so that waiting cannot fail.
                Verdict::Await => {
                    let _ = changes.wait_for(|state| *state != State::Probing).await;
                }
            }
        }
    }

    /// Whether no call passes at the moment.
    pub fn is_open(&self) -> bool {
        matches!(*self.state.borrow(), State::Open { until } if until > Instant::now())
    }

    fn decide(&self) -> Verdict {
        let mut verdict = Verdict::Await;
        self.state.send_if_modified(|state| {
            let now = Instant::now();
            let (decided, next) = match *state {
                State::Closed { .. } => (Verdict::Pass { probe: false }, *state),
                State::Open { until } if until > now => {
                    (Verdict::Refuse(Open { wait: until - now }), *state)
                }
                State::Open { .. } => (Verdict::Pass { probe: true }, State::Probing),
                State::Probing => (Verdict::Await, *state),
            };
            verdict = decided;
            let changed = next != *state;
            *state = next;
            changed
        });
        verdict
    }

    fn tell(&self, probe: bool, ended: Ended) {
        self.state.send_modify(|state| {
            let opened = State::Open { until: Instant::now() + self.open_for };
            *state = match (*state, probe, ended) {
                (State::Probing, true, Ended::Well) => State::Closed { failed: 0 },
                (State::Probing, true, Ended::Badly) => opened,
                // Nobody knows; the next call tries.
                (State::Probing, true, Ended::Dropped) => State::Open { until: Instant::now() },
                (State::Closed { .. }, _, Ended::Well) => State::Closed { failed: 0 },
                (State::Closed { failed }, _, Ended::Badly) if failed + 1 >= self.failures => {
                    opened
                }
                (State::Closed { failed }, _, Ended::Badly) => State::Closed { failed: failed + 1 },
                // What was sent before the breaker opened says nothing about the server now.
                (unchanged, _, _) => unchanged,
            };
        });
    }
}

#[derive(Debug, Clone, Copy)]
enum Ended {
    Well,
    Badly,
    Dropped,
}

/// The leave to make one call, whose end is told to the breaker.
#[derive(Debug)]
pub struct Admission<'a> {
    breaker: &'a Breaker,
    probe: bool,
    told: bool,
}

impl Admission<'_> {
    /// The server answered.
    pub fn succeeded(mut self) {
        self.end(Ended::Well);
    }

    /// It did not.
    pub fn failed(mut self) {
        self.end(Ended::Badly);
    }

    fn end(&mut self, ended: Ended) {
        self.told = true;
        self.breaker.tell(self.probe, ended);
    }
}

impl Drop for Admission<'_> {
    fn drop(&mut self) {
        if !self.told {
            self.end(Ended::Dropped);
        }
    }
}

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
    async fn failures_in_a_row_open_it_and_a_success_starts_the_count_anew() {
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
    async fn half_open_lets_one_call_try_and_the_others_wait_for_it() {
        let breaker = opened().await;
        tokio::time::advance(OPEN_FOR).await;
        let probe = breaker.admit().await.unwrap();
        let mut other = pin!(breaker.admit());
        assert!(poll!(&mut other).is_pending());
        probe.succeeded();
        assert!(other.await.is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn a_failed_try_opens_it_again() {
        let breaker = opened().await;
        tokio::time::advance(OPEN_FOR).await;
        breaker.admit().await.unwrap().failed();
        assert_eq!(breaker.admit().await.unwrap_err(), Open { wait: OPEN_FOR });
    }

    #[tokio::test(start_paused = true)]
    async fn a_try_that_was_given_up_leaves_the_next_one_to_try() {
        let breaker = opened().await;
        tokio::time::advance(OPEN_FOR).await;
        drop(breaker.admit().await.unwrap());
        assert!(breaker.admit().await.unwrap().probe);
    }
}
