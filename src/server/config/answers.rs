//! Answers at once, and the jobs that follow them.

use serde::{Deserialize, Serialize};

use super::RefinerChoice;

/// `[idempotency]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Idempotency {
    /// For how many hours an answer is given again.
    pub keep_hours: u32,
    /// How many answers are kept.
    pub max: usize,
}

/// `[localize]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Localize {
    /// Candidates in an answer by default.
    pub k: usize,
    /// Maximum number of candidates in an answer.
    pub max_k: usize,
    /// The least confidence of a known place.
    pub known_confidence: f64,
}

/// `[confidence]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Confidence {
    /// Images that are asked as if they were frames, at most.
    pub images: usize,
    /// Of these, how many are also refined.
    pub refined: usize,
    /// Images before and after one that show the same place.
    pub place_images: usize,
    /// The size of a place, in metres.
    pub place_m: f64,
}

/// `[jobs]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Jobs {
    /// Jobs that may wait or run.
    pub queue: usize,
    /// The share of `image.queue` from which frames get no job.
    pub shed_at: f64,
    /// Jobs refined side by side in this process; 0: others refine.
    pub workers: usize,
    /// The lease of a job, in seconds.
    pub lease_s: u64,
    /// The longest a job may take, in seconds.
    pub timeout_s: u64,
    /// How often a job is tried.
    pub attempts: u32,
    /// The pause before the second try, in seconds; it doubles each time.
    pub retry_pause_s: u64,
    /// The longest wait of a caller, in seconds.
    pub max_wait_s: u64,
    /// How long a job is kept after it has ended, in days; 0: for ever.
    pub keep_days: u32,
    /// The most jobs that have ended; 0: any number.
    pub keep_count: usize,
    /// The pause between two looks for jobs to remove, in seconds.
    pub sweep_s: u64,
    /// The most jobs removed in one change.
    pub sweep_batch: usize,
}

/// `[refine]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Refine {
    /// Who refines.
    pub refiner: RefinerChoice,
    /// Candidates that `mllm` compares.
    pub candidates: usize,
    /// Candidates that `local` compares.
    pub local_candidates: usize,
    /// Memory for dense features, in bytes.
    pub dense_cache_bytes: usize,
}
