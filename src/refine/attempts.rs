//! The retry policy of refinements, for jobs in the queue and for callers that wait.

use std::time::Duration;

use backon::{BackoffBuilder, ExponentialBuilder, Retryable};

use super::RefineError;

/// How often a refinement is attempted, and how long to pause between attempts.
///
/// A permanent error ends it; a transient one is retried with exponential backoff; a deferred one is
/// neither a failure nor an attempt.
#[derive(Debug, Clone, Copy)]
pub struct AttemptPolicy {
    /// Attempts at most, the first included.
    pub attempts: u32,
    /// The pause before the second attempt; it doubles with each further one.
    pub pause: Duration,
    /// The longest pause.
    pub longest_pause: Duration,
}

/// What follows a failed attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NextAttempt {
    /// There is none.
    Never,
    /// The refinement is attempted again after a pause.
    After {
        /// The pause.
        pause: Duration,
        /// Whether the failed attempt counts against [`AttemptPolicy::attempts`].
        counts: bool,
    },
}

impl AttemptPolicy {
    /// Returns what follows attempt number `attempt` (from 1), which failed with this error.
    pub fn next(&self, attempt: u32, error: &RefineError) -> NextAttempt {
        match error {
            RefineError::Permanent(_) => NextAttempt::Never,
            RefineError::Deferred { after, .. } => {
                NextAttempt::After { pause: *after, counts: false }
            }
            RefineError::Transient(_) => {
                let retry = attempt.saturating_sub(1) as usize;
                match self.backoff().build().nth(retry) {
                    Some(pause) => NextAttempt::After { pause, counts: true },
                    None => NextAttempt::Never,
                }
            }
        }
    }

    /// Calls `refine` until it succeeds or is not to be retried. A deferred refinement is returned to the
    /// caller at once: it may wait for hours.
    pub async fn run<T, F>(&self, refine: impl FnMut() -> F) -> Result<T, RefineError>
    where
        F: Future<Output = Result<T, RefineError>>,
    {
        refine.retry(self.backoff()).when(|error| matches!(error, RefineError::Transient(_))).await
    }

    fn backoff(&self) -> ExponentialBuilder {
        ExponentialBuilder::new()
            .with_factor(2.0)
            .with_min_delay(self.pause)
            .with_max_delay(self.longest_pause)
            .with_max_times(self.attempts.saturating_sub(1) as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::Instant;

    const POLICY: AttemptPolicy = AttemptPolicy {
        attempts: 5,
        pause: Duration::from_secs(2),
        longest_pause: Duration::from_secs(10),
    };

    fn transient() -> RefineError {
        RefineError::Transient("busy".into())
    }

    #[test]
    fn pauses_double_up_to_the_longest_and_end_with_the_last_attempt() {
        let pauses: Vec<Option<u64>> = (1..=6)
            .map(|attempt| match POLICY.next(attempt, &transient()) {
                NextAttempt::After { pause, counts: true } => Some(pause.as_secs()),
                NextAttempt::After { .. } => panic!("a transient failure counts"),
                NextAttempt::Never => None,
            })
            .collect();
        assert_eq!(pauses, [Some(2), Some(4), Some(8), Some(10), None, None]);
    }

    #[test]
    fn a_permanent_error_is_not_retried_and_a_deferred_one_does_not_count() {
        let permanent = RefineError::Permanent("gone".into());
        assert_eq!(POLICY.next(1, &permanent), NextAttempt::Never);
        let after = Duration::from_secs(3600);
        let deferred = RefineError::Deferred { why: "the day is spent".into(), after };
        assert_eq!(POLICY.next(99, &deferred), NextAttempt::After { pause: after, counts: false });
    }

    async fn run(errors: Vec<RefineError>) -> (Result<u8, RefineError>, usize, u64) {
        let (start, mut attempts) = (Instant::now(), 0);
        let mut errors = errors.into_iter();
        let outcome = POLICY
            .run(|| {
                attempts += 1;
                std::future::ready(errors.next().map_or(Ok(7), Err))
            })
            .await;
        (outcome, attempts, start.elapsed().as_secs())
    }

    #[tokio::test(start_paused = true)]
    async fn transient_errors_are_retried_until_success() {
        let (outcome, attempts, seconds) = run(vec![transient(), transient()]).await;
        assert_eq!((outcome.unwrap(), attempts, seconds), (7, 3, 6));
    }

    #[tokio::test(start_paused = true)]
    async fn the_last_error_is_returned_when_the_attempts_are_used_up() {
        let (outcome, attempts, seconds) = run((0..9).map(|_| transient()).collect()).await;
        assert!(matches!(outcome, Err(RefineError::Transient(_))));
        assert_eq!((attempts, seconds), (5, 2 + 4 + 8 + 10));
    }

    #[tokio::test(start_paused = true)]
    async fn permanent_and_deferred_errors_are_returned_at_once() {
        let after = Duration::from_secs(60);
        for error in [
            RefineError::Permanent("gone".into()),
            RefineError::Deferred { why: "later".into(), after },
        ] {
            let kind = std::mem::discriminant(&error);
            let (outcome, attempts, seconds) = run(vec![error]).await;
            assert_eq!(std::mem::discriminant(&outcome.unwrap_err()), kind);
            assert_eq!((attempts, seconds), (1, 0));
        }
    }
}
