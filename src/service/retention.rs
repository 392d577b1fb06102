//! Retention: removes old jobs, usage and idempotency records in the background. Deliveries of webhooks are
//! removed by their dispatcher.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio_util::sync::CancellationToken;

use super::IdempotencySettings;
use crate::ServiceMetrics;
use whereabouts_core::utc_day;
use whereabouts_refine::JobSettings;
use whereabouts_store::{IdempotencyStore, JobRetention, RemovedJobs, Retention, StoreError};

/// Removes jobs that have ended, with their queries and frames, and expired usage and idempotency records.
pub struct Janitor {
    /// Jobs and usage.
    pub store: Arc<dyn Retention>,
    /// Idempotency records.
    pub answers: Arc<dyn IdempotencyStore>,
    /// Counts removed jobs and frames.
    pub metrics: Arc<ServiceMetrics>,
    /// Retention of jobs, and the pace of removal.
    pub jobs: JobSettings,
    /// Retention of usage, in days.
    pub usage_days: u32,
    /// Retention of responses to requests with an idempotency key.
    pub idempotency: IdempotencySettings,
}

impl Janitor {
    /// Sweeps after each pause until `shutdown`.
    pub async fn run(&self, shutdown: CancellationToken) {
        while !shutdown.is_cancelled() {
            if let Err(error) = self.sweep(&shutdown).await {
                tracing::error!(%error, "expired records could not be removed");
            }
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = tokio::time::sleep(self.jobs.sweep) => {}
            }
        }
    }

    /// Removes everything that has expired; stops between two batches at `shutdown`.
    pub(crate) async fn sweep(&self, shutdown: &CancellationToken) -> Result<(), StoreError> {
        let now = Timestamp::now();
        let days = SignedDuration::from_hours(24 * i64::from(self.usage_days));
        self.store.forget_usage(utc_day(now).saturating_sub(days)).await?;
        self.store.collect_garbage().await?;
        let IdempotencySettings { most, .. } = self.idempotency;
        self.answers.prune_responses(self.idempotency.since(now), most).await?;
        let keep = JobRetention {
            since: self.jobs.keep.map(|keep| before(now, keep)),
            most: self.jobs.keep_count,
            settled: before(now, self.jobs.max_wait),
        };
        let mut removed = RemovedJobs::default();
        while !shutdown.is_cancelled() {
            let batch = self.store.remove_ended(keep, self.jobs.sweep_batch).await?;
            self.metrics.jobs_removed(&batch);
            removed += batch;
            if batch.jobs() < self.jobs.sweep_batch {
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

/// The time `duration` before `now`; the epoch if that cannot be represented.
pub(super) fn before(now: Timestamp, duration: Duration) -> Timestamp {
    let duration = SignedDuration::try_from(duration).unwrap_or(SignedDuration::MAX);
    now.saturating_sub(duration).unwrap_or(Timestamp::UNIX_EPOCH)
}
