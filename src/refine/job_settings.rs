//! Settings of refinement jobs.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::AttemptPolicy;
use whereabouts_core::units::{count_or_unlimited, days_or_unlimited, seconds};

/// Maximum lease that can be configured.
const MAX_LEASE: Duration = Duration::from_secs(24 * 3600);

/// `[jobs]`
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobSettings {
    /// Maximum number of jobs that are queued or running.
    pub queue: usize,
    /// Jobs are shed while more than this share of the admission queue is in use.
    pub shed_at: f64,
    /// Jobs that this process refines in parallel; with 0, other processes refine. Those that wait for a network do
    /// not count.
    pub workers: usize,
    /// The most jobs that this process has in progress, those that wait for a network included.
    pub in_progress: usize,
    /// How long a claim lasts. It must outlast `timeout`.
    #[serde(rename = "lease_s", with = "seconds")]
    pub lease: Duration,
    /// The longest a job may take.
    #[serde(rename = "timeout_s", with = "seconds")]
    pub timeout: Duration,
    /// How often a job is attempted.
    pub attempts: u32,
    /// Pause before the second attempt; it doubles with each further one.
    #[serde(rename = "retry_pause_s", with = "seconds")]
    pub retry_pause: Duration,
    /// The longest time that a caller may wait for a job, and the minimum time that a job is kept after it has
    /// ended, so that callers that wait for it see its end.
    #[serde(rename = "max_wait_s", with = "seconds")]
    pub max_wait: Duration,
    /// How long a job is kept after it has ended; `None` for no limit.
    #[serde(rename = "keep_days", with = "days_or_unlimited")]
    pub keep: Option<Duration>,
    /// Maximum number of jobs that have ended; `None` for no limit.
    #[serde(with = "count_or_unlimited")]
    pub keep_count: Option<usize>,
    /// Pause between two sweeps for jobs to remove.
    #[serde(rename = "sweep_s", with = "seconds")]
    pub sweep: Duration,
    /// Maximum number of jobs removed in one transaction.
    pub sweep_batch: usize,
}

impl JobSettings {
    /// Returns how often a job is attempted, with pauses that have no maximum.
    pub fn attempt_policy(&self) -> AttemptPolicy {
        let Self { attempts, retry_pause: pause, .. } = *self;
        AttemptPolicy { attempts, pause, longest_pause: Duration::MAX }
    }

    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        let zero = [
            ("queue", self.queue == 0),
            ("in_progress", self.in_progress == 0),
            ("attempts", self.attempts == 0),
            ("sweep_s", self.sweep.is_zero()),
            ("sweep_batch", self.sweep_batch == 0),
        ];
        if let Some((key, _)) = zero.iter().find(|(_, zero)| *zero) {
            return Some(format!("jobs.{key} must be at least 1"));
        }
        if self.lease > MAX_LEASE {
            return Some("jobs.lease_s must be at most a day".into());
        }
        if !(0.0..=1.0).contains(&self.shed_at) {
            return Some("jobs.shed_at must be from 0 to 1".into());
        }
        (self.lease <= self.timeout).then(|| {
            format!(
                "jobs.lease_s ({}) must outlast jobs.timeout_s ({}), or two workers would refine one job",
                self.lease.as_secs(),
                self.timeout.as_secs()
            )
        })
    }
}
