//! The retry policy of calls to the model.

use std::time::Duration;

use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimeParser;
use uuid::Uuid;

use super::failure::{Failure, FailureKind};

/// Why a call got no answer, after all its attempts.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// A retry would fail in the same way.
    #[error("{0}")]
    Permanent(String),
    /// The model gave no answer that can be used, although it was asked twice.
    #[error("{0}")]
    NoAnswer(String),
    /// A later retry may succeed.
    #[error("{0}")]
    Transient(String),
    /// The server refuses every call until its settings or account change, and so the circuit breaker opened.
    #[error("{why}")]
    Stopped {
        /// Why, in the server's words.
        why: String,
        /// Time until the next try.
        wait: Duration,
    },
    /// The circuit breaker is open because the last calls failed.
    #[error(
        "calls to the MLLM are suspended for another {} s, because the last ones failed: {cause}",
        wait.as_secs_f64().ceil()
    )]
    Suspended {
        /// Time until it lets a call through.
        wait: Duration,
        /// Why the last call failed.
        cause: String,
    },
    /// The day's budget is spent.
    #[error("the budget of the day is spent (mllm.tokens_per_day, mllm.money_per_day)")]
    DaySpent,
    /// The job's budget is spent.
    #[error("the budget of the job is spent (mllm.tokens_per_job, mllm.money_per_job)")]
    JobSpent,
}

/// Why one attempt got no answer, or none was made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum AttemptError {
    /// The attempt failed. If that opened the circuit breaker at once, the time until the next try.
    Failed(Failure, Option<Duration>),
    /// The server turned the call away while it worked on others of ours. That was one too many, and says nothing
    /// about this call.
    Crowded(Failure),
    /// The circuit breaker is open.
    Open {
        /// Time until it lets a call through.
        wait: Duration,
        /// Why the last call failed.
        cause: String,
    },
}

impl AttemptError {
    fn is_transient(&self) -> bool {
        match self {
            Self::Failed(failure, None) => failure.kind.is_transient(),
            Self::Crowded(_) => true,
            Self::Failed(_, Some(_)) | Self::Open { .. } => false,
        }
    }

    fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Failed(failure, _) | Self::Crowded(failure) => failure.retry_after,
            Self::Open { .. } => None,
        }
    }
}

/// How often a call is attempted, and how long to pause between attempts.
#[derive(Debug, Clone, Copy)]
pub struct CallRetryPolicy {
    /// Attempts at most, the first included.
    pub attempts: u32,
    /// The pause before the second attempt; it doubles with each further one, and jitter shortens it by up
    /// to half.
    pub backoff: Duration,
    /// The longest `Retry-After` that is honoured; a server that asks for more gets no further attempt.
    pub longest_retry_after: Duration,
}

/// The longest pause of exponential backoff.
const LONGEST_BACKOFF: Duration = Duration::from_secs(20);

/// How often a call may be turned away because of our other calls, besides its attempts, and how often the pause after
/// that doubles. The limit on calls at once follows what the server bears, so this is rare.
const MOST_CROWDED: u32 = 64;
const CROWDED_DOUBLINGS: u32 = 2;

impl CallRetryPolicy {
    /// Calls `attempt` until it succeeds or is not to be retried.
    pub async fn run<T, F>(&self, mut attempt: impl FnMut() -> F) -> Result<T, CallError>
    where
        F: Future<Output = Result<T, AttemptError>>,
    {
        let (mut attempts, mut crowded) = (0, 0);
        loop {
            let error = match attempt().await {
                Ok(answer) => return Ok(answer),
                Err(error) => error,
            };
            let doublings = if matches!(error, AttemptError::Crowded(_)) {
                crowded += 1;
                crowded.min(CROWDED_DOUBLINGS + 1) - 1
            } else {
                attempts += 1;
                attempts - 1
            };
            let is_last = attempts >= self.attempts || crowded >= MOST_CROWDED;
            let asked = error.retry_after();
            let is_too_late = asked.is_some_and(|asked| asked > self.longest_retry_after);
            if is_last || is_too_late || !error.is_transient() {
                return Err(self.give_up(error, attempts + crowded));
            }
            let pause = self.backoff.saturating_mul(2_u32.saturating_pow(doublings));
            let pause = pause.min(LONGEST_BACKOFF).mul_f64(1.0 - random_fraction() / 2.0);
            tokio::time::sleep(pause.max(asked.unwrap_or_default())).await;
        }
    }

    fn give_up(&self, error: AttemptError, attempts: u32) -> CallError {
        let (failure, stopped) = match error {
            AttemptError::Open { wait, cause } => return CallError::Suspended { wait, cause },
            AttemptError::Failed(failure, stopped) => (failure, stopped),
            AttemptError::Crowded(failure) => (failure, None),
        };
        let why = failure.why;
        if let Some(wait) = stopped {
            return CallError::Stopped { why, wait };
        }
        if failure.kind == FailureKind::Filtered {
            return CallError::NoAnswer(why);
        }
        if !failure.kind.is_transient() {
            return CallError::Permanent(why);
        }
        match failure.retry_after.filter(|asked| *asked > self.longest_retry_after) {
            Some(asked) => CallError::Transient(format!(
                "{why}; it asks for a retry after {} s, later than mllm.retry_after_max_s",
                asked.as_secs_f64().ceil()
            )),
            None => CallError::Transient(format!("{why} (tried {attempts} times)")),
        }
    }
}

/// Returns a random number from 0 to 1, from the random low bits of a version 7 UUID.
pub fn random_fraction() -> f64 {
    let (_, low) = Uuid::now_v7().as_u64_pair();
    f64::from(low as u32) / f64::from(u32::MAX)
}

/// Parses a `Retry-After` header: seconds, which some servers write with a fraction, or a date (RFC 9110,
/// section 10.2.3).
pub fn retry_after(value: &str, now: Timestamp) -> Option<Duration> {
    let value = value.trim();
    if let Ok(seconds) = value.trim_end_matches('s').parse::<f64>() {
        return Duration::try_from_secs_f64(seconds).ok();
    }
    let at = DateTimeParser::new().parse_timestamp(value).ok()?;
    Some(Duration::try_from(at.duration_since(now)).unwrap_or(Duration::ZERO))
}

/// Parses a `retry-after-ms` header, which is more exact than `Retry-After`.
pub fn retry_after_ms(value: &str) -> Option<Duration> {
    Duration::try_from_secs_f64(value.trim().parse::<f64>().ok()? / 1000.0).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::Instant;

    const POLICY: CallRetryPolicy = CallRetryPolicy {
        attempts: 4,
        backoff: Duration::from_millis(500),
        longest_retry_after: Duration::from_secs(60),
    };

    fn busy(seconds: Option<u64>) -> AttemptError {
        let retry_after = seconds.map(Duration::from_secs);
        let failure = Failure { retry_after, ..Failure::new(FailureKind::Busy, "429".into()) };
        AttemptError::Failed(failure, None)
    }

    async fn run(failures: Vec<AttemptError>) -> (Result<usize, CallError>, usize, Duration) {
        let (start, mut attempts) = (Instant::now(), 0);
        let mut failures = failures.into_iter();
        let outcome = POLICY
            .run(|| {
                attempts += 1;
                std::future::ready(failures.next().map_or(Ok(7), Err))
            })
            .await;
        (outcome, attempts, start.elapsed())
    }

    #[tokio::test(start_paused = true)]
    async fn a_429_is_retried_after_its_retry_after() {
        let (outcome, attempts, took) = run(vec![busy(Some(17))]).await;
        assert_eq!((outcome, attempts), (Ok(7), 2));
        assert!((17.0..17.1).contains(&took.as_secs_f64()), "{took:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn pauses_double_with_jitter() {
        let broken = AttemptError::Failed(Failure::new(FailureKind::Server, "500".into()), None);
        let (outcome, attempts, took) = run(vec![broken; 3]).await;
        assert_eq!((outcome, attempts), (Ok(7), 4));
        // 0.5 + 1 + 2 s, each cut by up to a half.
        assert!((1.75..3.51).contains(&took.as_secs_f64()), "{took:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn attempts_are_bounded() {
        let (outcome, attempts, _) = run(vec![busy(None); 9]).await;
        assert_eq!(outcome, Err(CallError::Transient("429 (tried 4 times)".into())));
        assert_eq!(attempts, 4);
    }

    #[tokio::test(start_paused = true)]
    async fn a_call_that_was_one_too_many_keeps_its_attempts() {
        let busy = Failure::new(FailureKind::Busy, "429".into());
        let (outcome, attempts, took) = run(vec![AttemptError::Crowded(busy.clone()); 20]).await;
        assert_eq!((outcome, attempts), (Ok(7), 21));
        // 0.5 + 1 + 18 × 2 s, each cut by up to a half.
        assert!((18.75..37.51).contains(&took.as_secs_f64()), "{took:?}");
        // But not for ever.
        let (outcome, attempts, _) = run(vec![AttemptError::Crowded(busy); 200]).await;
        assert!(matches!(outcome, Err(CallError::Transient(_))), "{outcome:?}");
        assert_eq!(attempts, MOST_CROWDED as usize);
    }

    #[tokio::test(start_paused = true)]
    async fn a_retry_after_beyond_the_limit_ends_the_attempts() {
        let (outcome, attempts, took) = run(vec![busy(Some(3600))]).await;
        assert!(matches!(outcome, Err(CallError::Transient(_))));
        assert_eq!((attempts, took), (1, Duration::ZERO));
    }

    #[tokio::test(start_paused = true)]
    async fn a_call_that_every_server_would_refuse_again_is_not_retried() {
        let (wait, why) = (Duration::from_secs(30), String::from("401"));
        let refused = AttemptError::Failed(Failure::new(FailureKind::Key, why.clone()), Some(wait));
        let (outcome, attempts, _) = run(vec![refused]).await;
        assert_eq!((outcome, attempts), (Err(CallError::Stopped { why, wait }), 1));
    }

    #[test]
    fn retry_after_is_seconds_or_a_date() {
        let now = "1994-11-06T08:49:37Z".parse().unwrap();
        assert_eq!(retry_after("120", now), Some(Duration::from_secs(120)));
        let date = retry_after("Sun, 06 Nov 1994 08:50:07 GMT", now);
        assert_eq!(date, Some(Duration::from_secs(30)));
        let past = retry_after("Sun, 06 Nov 1994 08:00:00 GMT", now);
        assert_eq!(past, Some(Duration::ZERO));
        assert_eq!(retry_after("0.25", now), Some(Duration::from_millis(250)));
        assert_eq!(retry_after("6s", now), Some(Duration::from_secs(6)));
        assert_eq!(retry_after_ms("1500"), Some(Duration::from_millis(1500)));
        for wrong in ["soon", "-1", "NaN", "inf", "1e400", ""] {
            assert_eq!((retry_after(wrong, now), retry_after_ms(wrong)), (None, None), "{wrong}");
        }
    }
}
