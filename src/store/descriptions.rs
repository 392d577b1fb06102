//! The cache of pairwise descriptions: each is bought once and kept until it is evicted.

use std::time::Duration;

use async_trait::async_trait;
use jiff::Timestamp;
use uuid::Uuid;

use super::StoreError;
use whereabouts_core::{
    CacheLevels, CachedDescription, DescribedFrame, Descriptor, Digest, SimilarFrame,
};

/// Bounds of the description cache.
#[derive(Debug, Clone, Copy)]
pub struct DescriptionBounds {
    /// Maximum size of all records, in bytes.
    pub max_bytes: u64,
    /// Older descriptions have expired and are no longer returned.
    pub max_age: Duration,
}

/// Descriptions by key. A key covers everything that shapes the text: both pictures, the prompt, the
/// model and its sampling parameters.
#[async_trait]
pub trait DescriptionCache: Send + Sync {
    /// Returns the description with this key, if it is cached and has not expired.
    async fn description(&self, key: &Digest) -> Result<Option<CachedDescription>, StoreError>;
    /// Caches a description; it is on disk when this returns.
    async fn keep_description(
        &self,
        key: Digest,
        value: CachedDescription,
    ) -> Result<(), StoreError>;

    /// Acquires the right to buy the description with this key, so that no two processes pay for the
    /// same one. The lease expires at `until`. Returns `false` while another process holds it.
    ///
    /// A store with a single process always grants it.
    async fn acquire_lease(&self, key: &Digest, until: Timestamp) -> Result<bool, StoreError> {
        let _ = (key, until);
        Ok(true)
    }
    /// Releases the lease of this process without a description having been bought.
    async fn release_lease(&self, key: &Digest) -> Result<(), StoreError> {
        let _ = key;
        Ok(())
    }

    /// Returns a few earlier frames of the map whose cosine similarity to a descriptor is at least
    /// `at_least`, the most similar first.
    async fn similar_frames(
        &self,
        map: Uuid,
        to: &Descriptor,
        at_least: f32,
    ) -> Result<Vec<SimilarFrame>, StoreError>;
    /// Stores a frame of the map whose pairs were described, and deletes the oldest frames in excess
    /// of `max_frames`.
    async fn keep_frame(
        &self,
        map: Uuid,
        frame: DescribedFrame,
        max_frames: usize,
    ) -> Result<(), StoreError>;

    /// Returns the number of cached descriptions and their size.
    fn levels(&self) -> CacheLevels;
}
