//! What must outlive the process: maps, images, descriptors, image bytes, queries and jobs.
//!
//! The traits say what a store promises; `embedded` keeps the promise for one process with sled and plain
//! files, `postgres` for many with PostgreSQL and an object store. Every call that returns `Ok` after a
//! change means that the change is on disk.

mod changes;
mod descriptions;
pub mod embedded;
mod jobs;
mod limits;
mod listing;
#[cfg(feature = "postgres")]
mod objects;
#[cfg(feature = "postgres")]
pub mod postgres;
mod webhooks;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use futures_util::future::try_join_all;
use jiff::Timestamp;
use jiff::civil::Date;
use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use uuid::Uuid;

pub use self::descriptions::DescriptionCache;
pub use self::jobs::{Claim, JobRecord, JobStore, Query, Release, Step};
pub use self::limits::{Buckets, SharedLimits, TokenGrant, TokenRequest};
pub use self::listing::{JobFilter, JobList};
#[cfg(feature = "postgres")]
pub use self::objects::{ObjectSettings, Objects};
pub use self::webhooks::{ForgottenDeliveries, KeepDeliveries, StoredDelivery, WebhookStore};
use whereabouts_core::ExportedImage;
use whereabouts_core::{
    Calibration, CalibrationSettings, Candidate, DayUsage, Descriptor, Digest, Image, ImageId, Map,
    MapName, Pose, StoredKey,
};
use whereabouts_index::SearchMode;

/// Why a store did not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// There is no such thing.
    #[error("{0}")]
    NotFound(String),
    /// It contradicts what is stored.
    #[error("{0}")]
    Conflict(String),
    /// The descriptors of the map were replaced since the caller looked at it.
    #[error("the descriptors of the map {0} were replaced meanwhile; try again")]
    Superseded(MapName),
    /// The job queue has reached its bound.
    #[error("the refinement queue holds {limit} jobs, its bound (jobs.queue)")]
    QueueFull {
        /// The bound.
        limit: usize,
    },
    /// The disk has less room left than is kept free.
    #[error(
        "the disk of the data folder is full: {free} bytes are free, and data.min_free_bytes keeps \
         {kept} of them; make room, or delete images or maps"
    )]
    Full {
        /// Bytes that are free.
        free: u64,
        /// The bound.
        kept: u64,
    },
    /// What the store is made of cannot be reached, or is too busy.
    #[error("{0}")]
    Unavailable(String),
    /// The disk or the database failed.
    #[error("the store failed: {0}")]
    Failed(String),
    /// What is stored is not what was written.
    #[error("the store is damaged: {0}")]
    Damaged(String),
}

/// All that a store does.
pub trait Store:
    MapStore
    + ExportStore
    + DraftStore
    + BlobStore
    + JobStore
    + UsageStore
    + KeyStore
    + IdempotencyStore
    + WebhookStore
    + DescriptionCache
    + Retention
{
}

impl<T> Store for T where
    T: MapStore
        + ExportStore
        + DraftStore
        + BlobStore
        + JobStore
        + UsageStore
        + KeyStore
        + IdempotencyStore
        + WebhookStore
        + DescriptionCache
        + Retention
{
}

/// Bounds of the cache of descriptions.
#[derive(Debug, Clone, Copy)]
pub struct DescriptionBounds {
    /// The most bytes of records.
    pub max_bytes: u64,
    /// Older descriptions are not used any more.
    pub max_age: Duration,
}

/// What became of an image that was sent.
#[derive(Debug, Clone, PartialEq)]
pub enum Added {
    /// It is new.
    Created(Image),
    /// The same id with the same bytes was there already; nothing changed.
    Present(Image),
}

/// Maps, their images and their descriptors.
#[async_trait]
pub trait MapStore: Send + Sync {
    /// Creates the map, or changes the one of that name: scene and description always, model,
    /// descriptor and frame while it has no images ([`StoreError::Conflict`] afterwards).
    /// Returns the map as stored, and whether it is new.
    async fn put_map(&self, map: Map) -> Result<(Map, bool), StoreError>;
    /// The map of that name.
    async fn map(&self, name: &MapName) -> Result<Option<Map>, StoreError>;
    /// All maps, by name.
    async fn maps(&self) -> Result<Vec<Map>, StoreError>;
    /// Removes a map and all its images; `false` if there was none.
    async fn delete_map(&self, name: &MapName) -> Result<bool, StoreError>;
    /// How a map is indexed at the moment.
    async fn index_state(&self, map: &Map) -> Result<IndexState, StoreError>;

    /// Adds an image; its bytes must be among the stored blobs.
    /// [`StoreError::Conflict`] if the id is taken by other bytes, [`StoreError::Superseded`] if the
    /// descriptor is of another revision than the map.
    async fn add_image(
        &self,
        map: &Map,
        image: Image,
        descriptor: Descriptor,
    ) -> Result<Added, StoreError>;
    /// One image.
    async fn image(&self, map: &Map, id: &ImageId) -> Result<Option<Image>, StoreError>;
    /// Returns the images with these ids: one entry for each id, in the order of `ids`, and `None` for an
    /// id that the map does not have.
    async fn images_by_id(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<Image>>, StoreError> {
        try_join_all(ids.iter().map(|id| self.image(map, id))).await
    }
    /// Images by id, those after `after`, at most `limit`.
    async fn images(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError>;
    /// The images that have a pose, in the order of their addition.
    async fn positions(&self, map: &Map) -> Result<Vec<(ImageId, Pose)>, StoreError>;
    /// Removes an image; `false` if there was none.
    async fn delete_image(&self, map: &Map, id: &ImageId) -> Result<bool, StoreError>;

    /// The `k` most similar images, best first; [`StoreError::Superseded`] if the query is of
    /// another revision than the map.
    async fn search(
        &self,
        map: &Map,
        query: Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError>;

    /// Images spread over the map, each with the `k` images of other places that are most like it. See
    /// [`CalibrationSettings`] for what is another place and how many there are.
    async fn look_alikes(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError>;
    /// What was last measured in this revision of the map, while it is the one that serves. It is
    /// derived: it may be lost.
    async fn calibration(&self, map: &Map) -> Result<Option<Arc<Calibration>>, StoreError>;
    /// Keeps what was measured.
    async fn put_calibration(&self, map: &Map, measured: Calibration) -> Result<(), StoreError>;
}

/// An image as if it were a frame of another place.
#[derive(Debug, Clone, PartialEq)]
pub struct HardNegatives {
    /// The image.
    pub image_id: ImageId,
    /// Images of other places, the most similar first.
    pub others: Vec<Candidate>,
}

/// Images with their descriptors.
#[async_trait]
pub trait ExportStore: Send + Sync {
    /// Images by id, those after `after`, at most `limit`; [`StoreError::Superseded`] if the map has
    /// other descriptors than the caller knows.
    async fn export(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<ExportedImage>, StoreError>;
}

/// Where the descriptors of a map are made anew while the old ones serve.
#[async_trait]
pub trait DraftStore: Send + Sync {
    /// Begins a draft of the map's next revision: `next` is the map as it will be.
    /// [`StoreError::Conflict`] while there is another draft of the map.
    async fn draft(&self, next: Map) -> Result<Box<dyn Draft>, StoreError>;
}

/// Descriptors in the making, which are to replace those of a map all at once. Images may be added
/// and removed meanwhile. A draft does not outlive its process.
#[async_trait]
pub trait Draft: Send + Sync {
    /// Some images that have no descriptor in the draft, at most `limit`; each must have been given
    /// one before the next call. None, if there are no more.
    async fn missing(&mut self, limit: usize) -> Result<Vec<Image>, StoreError>;
    /// Gives an image its descriptor, unless it was removed meanwhile.
    async fn write(&mut self, image: &Image, descriptor: Descriptor) -> Result<(), StoreError>;
    /// Puts the draft in the place of the map's descriptors, for good and in one step; `false` if
    /// more images are missing by now.
    async fn replace(&mut self) -> Result<bool, StoreError>;
    /// Clears away a draft that is given up.
    async fn discard(self: Box<Self>);
}

/// How a map is indexed at the moment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IndexState {
    /// Images in the map.
    pub images: usize,
    /// Whether a graph is in use.
    pub graph: bool,
    /// Whether images wait to be put into the graph; they are searched exactly.
    pub behind: bool,
    /// How often images were added and removed since the store was opened.
    pub changes: u64,
}

/// Image bytes, by digest.
#[async_trait]
pub trait BlobStore: Send + Sync {
    /// Stores bytes. They stay at least until the returned pin is dropped, and after that as long
    /// as an image or a query refers to them.
    async fn put_blob(&self, digest: Digest, bytes: Bytes) -> Result<BlobPin, StoreError>;
    /// The bytes of that digest.
    async fn blob(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError>;
}

/// Keeps fresh bytes from being collected before something refers to them.
pub type BlobPin = Box<dyn std::any::Any + Send>;

/// What calls to models outside have cost.
#[async_trait]
pub trait UsageStore: Send + Sync {
    /// Adds to what was spent on that day in that map.
    async fn add_usage(&self, spent: DayUsage) -> Result<(), StoreError>;
    /// What was spent from that day on, by day and map, oldest first.
    async fn usage(&self, from: Date) -> Result<Vec<DayUsage>, StoreError>;
}

/// API keys.
#[async_trait]
pub trait KeyStore: Send + Sync {
    /// Stores a key, in the place of one of the same id.
    async fn put_key(&self, key: StoredKey) -> Result<(), StoreError>;
    /// All keys, in no order.
    async fn keys(&self) -> Result<Vec<StoredKey>, StoreError>;
    /// Told when keys were made or revoked, where other processes do that too.
    fn changed_keys(&self) -> Option<watch::Receiver<()>> {
        None
    }
}

/// What became of a request that may be sent again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IdempotencyRecord {
    /// Tells it from another request.
    pub fingerprint: Digest,
    /// When it was begun, or answered.
    pub at: Timestamp,
    /// How far it has come.
    pub progress: Progress,
}

/// How far a request has come that may be sent again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Progress {
    /// It is being done.
    Running {
        /// By this process.
        process: Uuid,
        /// The job that was queued for it, by this process or by one that ended too soon to answer.
        #[serde(default)]
        job: Option<Uuid>,
    },
    /// It was done.
    Answered(StoredResponse),
}

/// An answer that is given again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoredResponse {
    /// The HTTP status.
    pub status: u16,
    /// The media type of the body.
    pub content_type: Option<String>,
    /// The body.
    pub body: String,
}

/// First answers to requests that may be sent again.
#[async_trait]
pub trait IdempotencyStore: Send + Sync {
    /// What is known of the request with this id; or, if that is nothing, is older than `since`, or is of a
    /// process that has ended, `None`, and from now on it is `reserved`, together with the job that that
    /// process queued for it.
    async fn reserve_answer(
        &self,
        id: &str,
        reserved: IdempotencyRecord,
        since: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError>;
    /// Keeps the answer.
    async fn keep_answer(&self, id: &str, answer: IdempotencyRecord) -> Result<(), StoreError>;
    /// Forgets that there was such a request.
    async fn forget_answer(&self, id: &str) -> Result<(), StoreError>;
    /// Forgets those from before that moment, and the oldest of those that are more than `most`. Returns
    /// how many.
    async fn forget_answers(&self, before: Timestamp, most: usize) -> Result<usize, StoreError>;
}

/// Which of the jobs that have ended are kept. A job is removed with its query and its frame.
#[derive(Debug, Clone, Copy)]
pub struct KeepJobs {
    /// Only those that ended since then, if it is given.
    pub since: Option<Timestamp>,
    /// Only so many, if it is given; the first to end go first.
    pub most: Option<usize>,
    /// All that ended after this moment, whatever the two above say.
    pub settled: Timestamp,
}

/// What was removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RemovedJobs {
    /// Jobs that ended too long ago.
    pub by_age: usize,
    /// Jobs of which there were too many.
    pub by_count: usize,
    /// Bytes of frames that nothing refers to any more.
    pub bytes: u64,
}

impl RemovedJobs {
    /// Jobs removed.
    pub fn jobs(&self) -> usize {
        self.by_age + self.by_count
    }
}

impl std::ops::AddAssign for RemovedJobs {
    fn add_assign(&mut self, other: Self) {
        self.by_age += other.by_age;
        self.by_count += other.by_count;
        self.bytes += other.bytes;
    }
}

/// Forgetting what has had its time.
#[async_trait]
pub trait Retention: Send + Sync {
    /// Removes jobs that are not to be kept, at most `batch` of them, so that no change waits long.
    async fn remove_ended(&self, keep: KeepJobs, batch: usize) -> Result<RemovedJobs, StoreError>;
    /// Forgets what was spent before that day.
    async fn forget_usage(&self, before: Date) -> Result<(), StoreError>;
    /// Clears away what processes that are gone have left, and descriptions beyond their bounds.
    async fn clear_left(&self) -> Result<(), StoreError>;
    /// Bytes of the database's files.
    async fn db_bytes(&self) -> Result<u64, StoreError>;
    /// Bytes of each map's descriptors and their index.
    async fn index_bytes(&self) -> Result<Vec<(MapName, u64)>, StoreError>;
    /// Bytes that are free where pictures are kept; `None` where that cannot be told.
    async fn free_bytes(&self) -> Option<u64>;
}
