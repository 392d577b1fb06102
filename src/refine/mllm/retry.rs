//! When a failed call is tried again, and how long after.

use std::time::Duration;

use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimeParser;
use uuid::Uuid;

use super::breaker::Open;

/// Why a call gave no answer in the end.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// Trying again would change nothing.
    #[error("{0}")]
    Permanent(String),
    /// It may work another time.
    #[error("{0}")]
    Transient(String),
    /// Too many calls have failed lately; none is made for a while.
    #[error(
        "calls to the MLLM are suspended for another {} s, because the last ones failed",
        wait.as_secs_f64().ceil()
    )]
    Suspended {
        /// How long.
        wait: Duration,
    },
    /// The day's budget is spent.
    #[error("the budget of the day is spent (mllm.tokens_per_day, mllm.money_per_day)")]
    DaySpent,
    /// The job's budget is spent.
    #[error("the budget of the job is spent (mllm.tokens_per_job, mllm.money_per_job)")]
    JobSpent,
}

/// Why one try gave no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// The server will not have this request.
    Refused(String),
    /// The server is there and asks for patience.
    Busy {
        /// What it said.
        why: String,
        /// When it wants to be asked again.
        retry_after: Option<Duration>,
    },
    /// The server or the way to it failed.
    Broken {
        /// How.
        why: String,
        /// When the server wants to be asked again.
        retry_after: Option<Duration>,
    },
    /// The server does not know `response_format`.
    Unstructured(String),
    /// The breaker is open.
    Open(Open),
}

impl Failure {
    /// Whether it speaks against the server rather than against the request.
    pub fn is_the_servers(&self) -> bool {
        matches!(self, Self::Broken { .. })
    }
}

/// How often and how soon.
#[derive(Debug, Clone, Copy)]
pub struct RetryPolicy {
    /// Tries at the most.
    pub attempts: u32,
    /// The first pause; each next one is twice as long.
    pub backoff: Duration,
    /// The longest `Retry-After` that is waited for.
    pub longest_wait: Duration,
}

/// No pause of our own choosing is longer.
const LONGEST_BACKOFF: Duration = Duration::from_secs(20);

impl RetryPolicy {
    /// Tries until there is an answer, or no hope.
    pub async fn run<T, F>(&self, mut attempt: impl FnMut() -> F) -> Result<T, CallError>
    where
        F: Future<Output = Result<T, Failure>>,
    {
        let mut tried = 0;
        loop {
            let (why, retry_after) = match attempt().await {
                Ok(answer) => return Ok(answer),
                Err(Failure::Open(Open { wait })) => return Err(CallError::Suspended { wait }),
                Err(Failure::Refused(why) | Failure::Unstructured(why)) => {
                    return Err(CallError::Permanent(why));
                }
                Err(Failure::Busy { why, retry_after } | Failure::Broken { why, retry_after }) => {
                    (why, retry_after)
                }
            };
            tried += 1;
            if tried >= self.attempts {
                return Err(CallError::Transient(format!("{why} (tried {tried} times)")));
            }
            tokio::time::sleep(self.pause(tried, retry_after, &why)?).await;
        }
    }

    fn pause(
        &self,
        tried: u32,
        retry_after: Option<Duration>,
        why: &str,
    ) -> Result<Duration, CallError> {
        let doubled = self.backoff.saturating_mul(2_u32.saturating_pow(tried - 1));
        let backoff = doubled.min(LONGEST_BACKOFF).mul_f64(0.5 + 0.5 * random_fraction());
        match retry_after {
            Some(wanted) if wanted > self.longest_wait => Err(CallError::Transient(format!(
                "{why}; it wants to be asked again in {} s, later than mllm.retry_after_max_s",
                wanted.as_secs()
            ))),
            Some(wanted) => Ok(wanted.max(backoff)),
            None => Ok(backoff),
        }
    }
}

/// 0 to 1. The low bits of a version 7 UUID are random; this saves a generator of our own.
pub fn random_fraction() -> f64 {
    let (_, low) = Uuid::now_v7().as_u64_pair();
    f64::from(low as u32) / f64::from(u32::MAX)
}

/// Reads `Retry-After`: seconds, or a date (RFC 9110, section 10.2.3).
pub fn retry_after(value: &str, now: Timestamp) -> Option<Duration> {
    let value = value.trim();
    if let Ok(seconds) = value.parse() {
        return Some(Duration::from_secs(seconds));
    }
    let at = DateTimeParser::new().parse_timestamp(value).ok()?;
    Some(Duration::try_from(at.duration_since(now)).unwrap_or(Duration::ZERO))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::Instant;

    const POLICY: RetryPolicy = RetryPolicy {
        attempts: 4,
        backoff: Duration::from_millis(500),
        longest_wait: Duration::from_secs(60),
    };

    fn busy(seconds: Option<u64>) -> Failure {
        Failure::Busy { why: "429".into(), retry_after: seconds.map(Duration::from_secs) }
    }

    async fn run(failures: Vec<Failure>) -> (Result<usize, CallError>, usize, Duration) {
        let (start, mut tries) = (Instant::now(), 0);
        let mut failures = failures.into_iter();
        let outcome = POLICY
            .run(|| {
                tries += 1;
                std::future::ready(failures.next().map_or(Ok(7), Err))
            })
            .await;
        (outcome, tries, start.elapsed())
    }

    #[tokio::test(start_paused = true)]
    async fn a_429_is_tried_again_when_the_server_says_so() {
        let (outcome, tries, took) = run(vec![busy(Some(17))]).await;
        assert_eq!((outcome, tries), (Ok(7), 2));
        assert!((17.0..17.1).contains(&took.as_secs_f64()), "{took:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn pauses_double_with_jitter() {
        let broken = Failure::Broken { why: "500".into(), retry_after: None };
        let (outcome, tries, took) = run(vec![broken; 3]).await;
        assert_eq!((outcome, tries), (Ok(7), 4));
        // 0.5 + 1 + 2 s, each cut by up to a half.
        assert!((1.75..3.51).contains(&took.as_secs_f64()), "{took:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn tries_are_bounded() {
        let (outcome, tries, _) = run(vec![busy(None); 9]).await;
        assert_eq!(outcome, Err(CallError::Transient("429 (tried 4 times)".into())));
        assert_eq!(tries, 4);
    }

    #[tokio::test(start_paused = true)]
    async fn a_server_that_asks_for_an_hour_is_not_waited_for() {
        let (outcome, tries, took) = run(vec![busy(Some(3600))]).await;
        assert!(matches!(outcome, Err(CallError::Transient(_))));
        assert_eq!((tries, took), (1, Duration::ZERO));
    }

    #[tokio::test(start_paused = true)]
    async fn what_is_refused_is_not_tried_again() {
        let (outcome, tries, _) = run(vec![Failure::Refused("401".into())]).await;
        assert_eq!((outcome, tries), (Err(CallError::Permanent("401".into())), 1));
    }

    #[test]
    fn retry_after_is_seconds_or_a_date() {
        let now = "1994-11-06T08:49:37Z".parse().unwrap();
        assert_eq!(retry_after("120", now), Some(Duration::from_secs(120)));
        let date = retry_after("Sun, 06 Nov 1994 08:50:07 GMT", now);
        assert_eq!(date, Some(Duration::from_secs(30)));
        let past = retry_after("Sun, 06 Nov 1994 08:00:00 GMT", now);
        assert_eq!(past, Some(Duration::ZERO));
        assert_eq!(retry_after("soon", now), None);
    }
}
