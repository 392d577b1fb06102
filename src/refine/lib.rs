//! The vision-language refiner: compares a query with each of its candidates, puts what agrees and
//! what differs into words, and orders the candidates anew.
//!
//! A [`Refiner`] does this for one job; the [`Worker`] takes jobs from the queue and hands them to
//! it. [`LocalRefiner`] compares dense features on this machine, [`mllm::MllmRefiner`] asks a
//! multimodal LLM.

mod dense_cache;
pub mod local;
mod local_refiner;
mod metrics;
pub mod mllm;
mod patience;
mod worker;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use parking_lot::Mutex;

pub use dense_cache::{DenseCache, DenseKey};
pub use local_refiner::LocalRefiner;
pub use metrics::{CacheLookup, RefineMetrics};
pub use worker::{Worker, WorkerSettings};

use whereabouts_core::PairRegion;
use whereabouts_core::ServiceTime;
use whereabouts_core::{Description, Evidence, ImageId, Map, Ranking, RefinerKind, Usage};
use whereabouts_store::{HardNegatives, JobRecord, Step, StoreError};

/// How fast jobs are done.
pub type JobServiceTime = Arc<Mutex<ServiceTime>>;

/// Compares and orders the candidates of one job.
#[async_trait]
pub trait Refiner: Send + Sync {
    /// Which refiner this is.
    fn kind(&self) -> RefinerKind;
    /// Whether it looks at the descriptor of a query's frame.
    fn wants_descriptor(&self) -> bool {
        false
    }
    /// How it stands, if it asks models outside.
    fn levels(&self) -> Option<mllm::MllmLevels> {
        None
    }
    /// Refines one job, and tells each step as it is done. Dropping the call stops it.
    async fn refine(
        &self,
        record: &JobRecord,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError>;
    /// What speaks for the first of candidates that are all wrong; `None` from a refiner that measures
    /// nothing of the kind, and for an image that is gone.
    async fn chance(
        &self,
        map: &Map,
        asked: &HardNegatives,
    ) -> Result<Option<Evidence>, RefineError> {
        let _ = (map, asked);
        Ok(None)
    }
    /// The regions that the frame of a job and one of its candidates have in common, the most telling
    /// first; `None` from a refiner that compares none, and for an image that is no candidate or gone.
    async fn regions(
        &self,
        record: &JobRecord,
        image: &ImageId,
    ) -> Result<Option<Vec<PairRegion>>, RefineError> {
        let _ = (record, image);
        Ok(None)
    }
}

/// Hears of the steps of a refinement.
#[async_trait]
pub trait Progress: Send + Sync {
    /// A step is done. What it cost is part of the refinement's usage too.
    async fn step(&self, step: Step);
}

/// What a refiner found.
#[derive(Debug, Clone, PartialEq)]
pub struct Refinement {
    /// One text for each candidate that could be compared, in coarse order.
    pub descriptions: Vec<Description>,
    /// The new order.
    pub ranking: Ranking,
    /// What speaks for the first of it, if that was measured.
    pub evidence: Option<Evidence>,
    /// Why it is so.
    pub reasoning: Option<String>,
    /// Milliseconds that the call took which gave the order, if there was one.
    pub reasoning_took_ms: Option<u64>,
    /// What this attempt cost.
    pub usage: Usage,
    /// Why part of the order is the coarse one, if it is.
    pub degraded: Option<String>,
}

/// A time as jobs tell it.
fn milliseconds(took: Duration) -> u64 {
    u64::try_from(took.as_millis()).unwrap_or(u64::MAX)
}

/// Why there is no refinement.
#[derive(Debug, thiserror::Error)]
pub enum RefineError {
    /// Trying again would change nothing.
    #[error("{0}")]
    Permanent(String),
    /// It may work the next time.
    #[error("{0}")]
    Transient(String),
    /// Nothing is wrong with the job, but now is not the time.
    #[error("{why}")]
    Deferred {
        /// What it waits for.
        why: String,
        /// How long to wait.
        after: Duration,
    },
}

impl From<StoreError> for RefineError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::NotFound(_) | StoreError::Conflict(_) | StoreError::Damaged(_) => {
                Self::Permanent(error.to_string())
            }
            StoreError::QueueFull { .. }
            | StoreError::Full { .. }
            | StoreError::Unavailable(_)
            | StoreError::Failed(_)
            | StoreError::Superseded(_) => Self::Transient(error.to_string()),
        }
    }
}
