//! The use cases, one type each. Each owns what it needs and knows the store by its traits only.
//!
//! HTTP, gRPC and the command line convert requests and responses; every decision is made here.

mod bulk;
mod calibration;
mod cancellation;
mod corrections;
mod crossfit;
mod descriptions;
mod error;
mod events;
mod fitter;
mod fitting;
mod idempotency;
mod images;
mod imaging;
mod jobs;
mod keys;
mod limits;
mod localize;
mod maps;
mod metrics;
mod models;
mod readiness;
mod reading;
mod recall;
mod refiners;
mod reindex;
mod rejections;
mod retention;
mod submit;
#[cfg(test)]
mod tests;
mod text_search;
mod track;
mod transfer;
mod usage;
mod vocabularies;
mod webhooks;
mod words;

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Semaphore;
use uuid::Uuid;

pub use self::bulk::{BulkImage, BulkItem, BulkResult, BulkSettings};
pub use self::calibration::{Calibrator, ConfidenceSettings};
pub use self::cancellation::Deadline;
pub use self::descriptions::Descriptions;
pub use self::error::ServiceError;
pub use self::events::{AnyJobEvent, JobEvent};
pub use self::fitter::VocabularyFitter;
pub use self::idempotency::{Idempotency, IdempotencyOutcome, IdempotencySettings};
pub use self::images::{Images, NewImage};
pub use self::imaging::Imaging;
pub use self::jobs::{Jobs, parse_search_text, uuid};
pub use self::keys::{Keys, Principal};
pub use self::limits::{Limits, RemainingLimit, RemainingLimits};
pub use self::localize::{LocalizeRequest, LocalizeSettings, Localizer, Retrieved};
pub use self::maps::Maps;
pub use self::metrics::{AttemptOutcome, ServiceMetrics};
pub use self::readiness::{Readiness, ReadinessPhase};
pub use self::reading::{Reading, ReadingSettings};
pub use self::recall::RecallCheck;
pub use self::refiners::{AllowedRefiners, Chosen};
pub use self::reindex::{Reindexer, Reindexes};
pub use self::rejections::{Rejection, Rejections};
pub use self::retention::Janitor;
pub use self::submit::Submitter;
pub use self::track::{FrameEvidence, Odometry, TrackSettings, TrackStep, Tracks};
pub use self::transfer::Transfer;
pub use self::usage::UsageReports;
pub use self::vocabularies::{Vocabularies, VocabularySettings};
pub use self::webhooks::{Dispatcher, WebhookSettings, Webhooks};
pub use self::words::{WordsLocalizer, WordsQuery};
use whereabouts_refine::{DenseCache, JobServiceTime, JobSettings, Refiner};
use whereabouts_store::{Retention, Store};
use whereabouts_vision::{Admission, CpuPool, LoadedModels};

/// Retries of a use case whose map was reindexed meanwhile. Reindexes are rare: more in a row mean a broken
/// store.
const SUPERSEDED_RETRIES: usize = 2;

/// The use cases of one process.
pub struct Service {
    /// Maps.
    pub maps: Maps,
    /// Reference images.
    pub images: Images,
    /// Localization of frames.
    pub localizer: Localizer,
    /// Finds places by descriptions.
    pub words: WordsLocalizer,
    /// Refinement jobs.
    pub jobs: Jobs,
    /// Reindexing of maps.
    pub reindexer: Reindexer,
    /// Vocabularies of maps' own.
    pub fitter: VocabularyFitter,
    /// Calibration of confidence.
    pub calibrator: Calibrator,
    /// The text in images and frames.
    pub reading: Arc<Reading>,
    /// Export and import of maps.
    pub transfer: Transfer,
    /// Usage reports.
    pub usage: UsageReports,
    /// The cache of descriptions.
    pub descriptions: Descriptions,
    /// Idempotency keys.
    pub idempotency: Idempotency,
    /// API keys.
    pub keys: Arc<Keys>,
    /// Webhooks.
    pub webhooks: Webhooks,
    /// Removal of expired records, and sizes on disk.
    pub retention: Arc<dyn Retention>,
    /// The cache of dense features.
    pub dense: Arc<DenseCache>,
    /// Metric families of the use cases.
    pub metrics: Arc<ServiceMetrics>,
}

/// The dependencies of the use cases.
pub struct ServiceParts {
    /// The store.
    pub store: Arc<dyn Store>,
    /// The id of this process.
    pub process: Uuid,
    /// API keys.
    pub keys: Keys,
    /// The loaded models.
    pub models: LoadedModels,
    /// Permits to decode an image and run a model on it.
    pub admission: Admission,
    /// The threads for decoding.
    pub pool: CpuPool,
    /// The refiner, if one is configured.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// Reads the text in images and frames.
    pub reading: Arc<Reading>,
    /// The cache of dense features.
    pub dense: Arc<DenseCache>,
    /// The average time of a job.
    pub job_service_time: JobServiceTime,
    /// Metric families of the use cases.
    pub metrics: Arc<ServiceMetrics>,
}

/// Bounds and defaults of the use cases.
#[derive(Debug, Clone)]
pub struct ServiceSettings {
    /// Localization.
    pub localize: LocalizeSettings,
    /// Tracks.
    pub track: TrackSettings,
    /// Calibration of confidence.
    pub confidence: ConfidenceSettings,
    /// Vocabularies of maps' own.
    pub vocabulary: VocabularySettings,
    /// Refinement jobs.
    pub jobs: JobSettings,
    /// The refiners that maps and requests may choose.
    pub refiners: AllowedRefiners,
    /// Number of candidates that a measurement of the calibration compares.
    pub compared: usize,
    /// Pause between two comparisons of a search with exact search; `None` for none.
    pub recall_check: Option<Duration>,
    /// Retention of usage, in days.
    pub usage_days: u32,
    /// Retention of responses to requests with an idempotency key.
    pub idempotency: IdempotencySettings,
    /// Bounds of bulk uploads.
    pub bulk: BulkSettings,
    /// Bounds of webhooks.
    pub webhooks: WebhookSettings,
}

impl Service {
    /// Builds all use cases over the same dependencies.
    pub fn new(parts: ServiceParts, settings: ServiceSettings) -> Self {
        let ServiceParts { store, process, keys, models, admission, pool, refiner, .. } = parts;
        let ServiceParts { dense, job_service_time, metrics, reading, .. } = parts;
        let (keys, admission) = (Arc::new(keys), Arc::new(admission));
        let imaging = Imaging {
            maps: store.clone(),
            models,
            vocabularies: Arc::new(Vocabularies::new(store.clone(), settings.vocabulary.loaded)),
            admission: Arc::clone(&admission),
            pool,
            metrics: Arc::clone(&metrics),
        };
        let maps = Maps {
            store: store.clone(),
            imaging: imaging.clone(),
            reindexes: Arc::default(),
            vocabulary: settings.vocabulary,
            refiners: settings.refiners.clone(),
            reading: Arc::clone(&reading),
        };
        let jobs = Jobs {
            store: store.clone(),
            blobs: store.clone(),
            imaging,
            refiner: refiner.clone(),
            matching: Arc::new(Semaphore::new(1)),
            searching: Arc::new(Semaphore::new(1)),
            max_wait: settings.jobs.max_wait,
            known_confidence: settings.localize.known_confidence,
        };
        let submitter = Submitter {
            jobs: store.clone(),
            blobs: store.clone(),
            dense: Arc::clone(&dense),
            refiner: refiner.clone(),
            admission,
            service_time: job_service_time,
            metrics: Arc::clone(&metrics),
            settings: settings.jobs,
        };
        let reindexer = Reindexer {
            maps: maps.clone(),
            drafts: store.clone(),
            blobs: store.clone(),
            settings: settings.vocabulary,
        };
        let place_m = settings.confidence.place_m;
        Self {
            images: Images {
                maps: maps.clone(),
                blobs: store.clone(),
                keys: Arc::clone(&keys),
                bulk: settings.bulk,
            },
            localizer: Localizer {
                maps: maps.clone(),
                tracks: Tracks::new(store.clone(), store.clone(), place_m, settings.track),
                submitter,
                jobs: jobs.clone(),
                recall: RecallCheck::new(settings.recall_check),
                settings: settings.localize,
                refiners: settings.refiners.clone(),
            },
            words: WordsLocalizer {
                maps: maps.clone(),
                settings: settings.localize,
                places: settings.confidence.calibration(settings.compared),
            },
            jobs,
            fitter: VocabularyFitter { reindexer: reindexer.clone(), leases: store.clone() },
            calibrator: Calibrator {
                store: store.clone(),
                refiner: refiner.clone(),
                settings: settings.confidence.calibration(settings.compared),
                model_candidates: settings.refiners.model_candidates().unwrap_or(settings.compared),
                reindexer: Some(reindexer.clone()),
            },
            reindexer,
            transfer: Transfer {
                maps: maps.clone(),
                exports: store.clone(),
                blobs: store.clone(),
                texts: store.clone(),
            },
            usage: UsageReports { store: store.clone(), refiner, keep_days: settings.usage_days },
            descriptions: Descriptions { cache: store.clone() },
            idempotency: Idempotency {
                store: store.clone(),
                process,
                settings: settings.idempotency,
            },
            keys,
            webhooks: Webhooks { store: store.clone(), settings: settings.webhooks },
            retention: store,
            reading,
            dense,
            metrics,
            maps,
        }
    }
}
