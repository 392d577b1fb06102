//! Durable state: maps, images, descriptors, image bytes, queries and jobs.
//!
//! The traits define what a store guarantees, one file for each subject. [`embedded`] implements them
//! for a single process with sled and plain files, `postgres` for many processes with PostgreSQL and
//! an object store. When a call that changes something returns `Ok`, the change is on disk.

mod blobs;
mod changes;
mod descriptions;
mod drafts;
pub mod embedded;
mod error;
mod idempotency;
mod jobs;
mod keys;
mod limits;
mod listing;
mod maps;
#[cfg(feature = "postgres")]
mod objects;
#[cfg(feature = "postgres")]
pub mod postgres;
mod retention;
mod texts;
mod tracks;
mod usage;
mod webhooks;

pub use self::blobs::{BlobPin, BlobStore};
pub use self::descriptions::{DescriptionBounds, DescriptionCache, DescriptionFilter};
pub use self::drafts::{Draft, DraftStore};
pub use self::error::StoreError;
pub use self::idempotency::{IdempotencyRecord, IdempotencyStore, Progress, StoredResponse};
pub use self::jobs::{Claim, JobRecord, JobStore, Query, Release, Step};
pub use self::keys::KeyStore;
pub use self::limits::{SharedLimits, TokenBuckets, TokenGrant, TokenRequest};
pub use self::listing::{JobFilter, JobList};
pub use self::maps::{Added, ExportStore, HardNegatives, IndexState, LocatedImage, MapStore};
#[cfg(feature = "postgres")]
pub use self::objects::{ObjectSettings, Objects};
pub use self::retention::{JobRetention, RemovedJobs, Retention};
pub use self::texts::{TextCandidate, TextCounts, TextStore};
pub use self::tracks::{StoredTrack, TrackHead, TrackKey, TrackRead, TrackState, TrackStore};
pub use self::usage::UsageStore;
pub use self::webhooks::{DeliveryRetention, RemovedDeliveries, StoredDelivery, WebhookStore};

/// Everything that a store does.
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
    + TrackStore
    + TextStore
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
        + TrackStore
        + TextStore
{
}
