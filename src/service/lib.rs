//! The use cases: what a request means, whoever brings it.
//!
//! HTTP and the command line convert to and from these calls and decide nothing. A [`Service`]
//! knows the stores by their traits alone.

mod admission;
mod bulk;
mod calibration;
mod door;
mod error;
mod events;
mod images;
mod jobs;
mod keys;
mod limits;
mod localize;
mod maps;
mod metrics;
mod models;
mod once;
mod recall;
mod refused;
mod reindex;
mod retention;
mod submit;
mod track;
mod transfer;
mod usage;
mod webhooks;

use std::sync::Arc;

use uuid::Uuid;

pub use self::bulk::{BulkImage, BulkResult, BulkSettings};
pub use self::door::{Readiness, ReadinessPhase};
pub use self::error::ServiceError;
pub use self::events::{AnyJobEvent, JobEvent};
pub use self::images::NewImage;
pub use self::jobs::{search_text, uuid};
pub use self::keys::{Keys, Principal};
pub use self::limits::{Allowance, Allowances, Limits};
pub use self::localize::{Deadline, LocalizeRequest, Retrieved};
pub use self::metrics::{AttemptOutcome, ServiceMetrics};
pub use self::once::{IdempotencySettings, Once};
pub use self::recall::RecallCheck;
pub use self::refused::{Rejection, Rejections};
pub use self::reindex::Reindexes;
pub use self::retention::{Janitor, RetentionSettings};
pub use self::track::{TrackSettings, TrackStep, Tracks};
pub use self::webhooks::{Dispatcher, WebhookSettings, Webhooks};
use whereabouts_core::CalibrationSettings;
use whereabouts_refine::{DenseCache, JobServiceTime, Refiner};
use whereabouts_store::{
    BlobStore, DraftStore, ExportStore, IdempotencyStore, JobStore, MapStore, Retention, UsageStore,
};
use whereabouts_vision::{Admission, CpuPool, LoadedModels};

/// Bounds and defaults of the use cases.
#[derive(Debug, Clone)]
pub struct ServiceSettings {
    /// Candidates in an answer by default.
    pub k: usize,
    /// Candidates in an answer at the most.
    pub max_k: usize,
    /// The least confidence of a known place.
    pub known_confidence: f64,
    /// How maps are measured.
    pub calibration: CalibrationSettings,
    /// Candidates that a job compares.
    pub candidates: usize,
    /// Jobs that may wait or run.
    pub job_queue: usize,
    /// The share of the queue before decoding from which frames get no job.
    pub shed_jobs_at: f64,
    /// The longest wait for a job.
    pub max_wait: std::time::Duration,
    /// For how many days it is known what was spent.
    pub usage_days: u32,
    /// What is kept of requests that may be sent again.
    pub once: IdempotencySettings,
    /// Bounds of bulk uploads.
    pub bulk: BulkSettings,
}

/// How often a use case begins again because the map's descriptors were replaced meanwhile. Twice in
/// a row would be strange; more often is a store that is broken.
const SUPERSEDED: usize = 2;

/// Everything a use case needs.
pub struct Service {
    /// Maps, images, descriptors.
    pub maps: Arc<dyn MapStore>,
    /// Descriptors in the making.
    pub drafts: Arc<dyn DraftStore>,
    /// How far that has come.
    pub reindexes: Reindexes,
    /// The frames of each robot, one after another.
    pub tracks: Tracks,
    /// Images with their descriptors.
    pub exports: Arc<dyn ExportStore>,
    /// Image bytes.
    pub blobs: Arc<dyn BlobStore>,
    /// Jobs.
    pub jobs: Arc<dyn JobStore>,
    /// First answers to requests that may be sent again.
    pub answers: Arc<dyn IdempotencyStore>,
    /// Tells this process from those before it.
    pub process: Uuid,
    /// What calls to models outside have cost.
    pub accounts: Arc<dyn UsageStore>,
    /// API keys.
    pub keys: Keys,
    /// Who is told of the ends of jobs.
    pub webhooks: Webhooks,
    /// The models in memory.
    pub models: LoadedModels,
    /// When a search was last held against exact search.
    pub recall: RecallCheck,
    /// Who may have a picture decoded and inferred.
    pub admission: Admission,
    /// Where pictures are decoded.
    pub pool: CpuPool,
    /// How fast jobs are done.
    pub job_pace: JobServiceTime,
    /// Who refines, if anybody.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// Dense features that a job will need soon.
    pub dense: Arc<DenseCache>,
    /// Matches are compared one pair after another: jobs go first.
    pub matching: tokio::sync::Semaphore,
    /// Jobs are searched for one text after another: each looks at many of them.
    pub searching: tokio::sync::Semaphore,
    /// Where they are all kept.
    pub retention: Arc<dyn Retention>,
    /// What is counted.
    pub metrics: Arc<ServiceMetrics>,
    /// Bounds and defaults.
    pub settings: ServiceSettings,
}
