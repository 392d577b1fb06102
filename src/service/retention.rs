//! Forgetting, in the background, what has had its time.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio_util::sync::CancellationToken;

use super::IdempotencySettings;
use crate::ServiceMetrics;
use whereabouts_core::utc_day;
use whereabouts_store::{IdempotencyStore, JobRetention, RemovedJobs, Retention, StoreError};

/// How long what is kept, and how it is removed.
#[derive(Debug, Clone, Copy)]
pub struct RetentionSettings {
    /// How long a job is kept after it has ended; `None`: for ever.
    pub keep: Option<Duration>,
    /// The most jobs that have ended; `None`: any number.
    pub most: Option<usize>,
    /// Kept in any case for so long, so that whoever waits for a job sees its end.
    pub settle: Duration,
    /// The pause between two looks.
    pub pause: Duration,
    /// The most jobs removed in one change.
    pub batch: usize,
    /// For how many days it is known what was spent.
    pub usage_days: u32,
    /// Which answers to requests that may be sent again are kept.
    pub once: IdempotencySettings,
}

/// Removes jobs that have ended, with their queries and frames, and old accounts.
pub struct Janitor {
    /// Where they are.
    pub store: Arc<dyn Retention>,
    /// Where answers are that may be given again.
    pub answers: Arc<dyn IdempotencyStore>,
    /// What is counted.
    pub metrics: Arc<ServiceMetrics>,
    /// What is kept.
    pub settings: RetentionSettings,
}

impl Janitor {
    /// Works until `shutdown`.
    pub async fn run(&self, shutdown: CancellationToken) {
        while !shutdown.is_cancelled() {
            if let Err(error) = self.look(&shutdown).await {
                tracing::error!(%error, "what has had its time cannot be removed");
            }
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = tokio::time::sleep(self.settings.pause) => {}
            }
        }
    }

    async fn look(&self, shutdown: &CancellationToken) -> Result<(), StoreError> {
        let now = Timestamp::now();
        let days = SignedDuration::from_hours(24 * i64::from(self.settings.usage_days));
        self.store.forget_usage(utc_day(now).saturating_sub(days)).await?;
        self.store.collect_garbage().await?;
        let once = self.settings.once;
        self.answers.prune_responses(once.since(now), once.most).await?;
        let keep = JobRetention {
            since: self.settings.keep.map(|keep| before(now, keep)),
            most: self.settings.most,
            settled: before(now, self.settings.settle),
        };
        let mut removed = RemovedJobs::default();
        while !shutdown.is_cancelled() {
            let batch = self.store.remove_ended(keep, self.settings.batch).await?;
            self.metrics.jobs_removed(&batch);
            removed += batch;
            if batch.jobs() < self.settings.batch {
                break;
            }
        }
        if removed.jobs() > 0 {
            let RemovedJobs { by_age, by_count, bytes } = removed;
            tracing::info!(by_age, by_count, frame_bytes = bytes, "ended jobs were removed");
        }
        Ok(())
    }
}

/// The moment so long before another; the epoch, if that is out of reach.
pub(super) fn before(now: Timestamp, duration: Duration) -> Timestamp {
    let duration = SignedDuration::try_from(duration).unwrap_or(SignedDuration::MAX);
    now.saturating_sub(duration).unwrap_or(Timestamp::UNIX_EPOCH)
}
