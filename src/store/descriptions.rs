//! The cache of pairwise descriptions: each is bought once and kept until it is evicted.

use std::time::Duration;

use async_trait::async_trait;
use jiff::Timestamp;
use uuid::Uuid;

use super::StoreError;
use whereabouts_core::{
    CacheLevels, CachedDescription, DescribedFrame, Descriptor, Digest, ImageId, MapName,
    SimilarFrame,
};

/// Bounds of the description cache.
#[derive(Debug, Clone, Copy)]
pub struct DescriptionBounds {
    /// Maximum size of all records, in bytes.
    pub max_bytes: u64,
    /// Older descriptions have expired and are no longer returned.
    pub max_age: Duration,
}

/// Which descriptions to list or to remove. Each field that is set must match.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DescriptionFilter {
    /// Of this map.
    pub map: Option<MapName>,
    /// About this image.
    pub image: Option<ImageId>,
    /// By this model.
    pub model: Option<String>,
    /// From the server at this base URL.
    pub server: Option<String>,
    /// With this in the text, ignoring case.
    pub text: Option<String>,
}

impl DescriptionFilter {
    /// Whether a description matches. One from an earlier version is about nothing.
    pub fn matches(&self, description: &CachedDescription) -> bool {
        fn is<T: PartialEq>(wanted: Option<&T>, found: Option<&T>) -> bool {
            wanted.is_none_or(|wanted| found == Some(wanted))
        }
        let about = description.about.as_ref();
        is(self.map.as_ref(), about.map(|about| &about.map))
            && is(self.image.as_ref(), about.map(|about| &about.image_id))
            && is(self.model.as_ref(), about.map(|about| &about.model))
            && is(self.server.as_ref(), about.map(|about| &about.server))
            && self
                .text
                .as_ref()
                .is_none_or(|text| description.text.to_lowercase().contains(&text.to_lowercase()))
    }
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

    /// Returns cached descriptions that match, in the order of their keys, after the key `after`.
    async fn descriptions(
        &self,
        filter: &DescriptionFilter,
        after: Option<&Digest>,
        limit: usize,
    ) -> Result<Vec<(Digest, CachedDescription)>, StoreError>;
    /// Removes these descriptions, and returns how many were there.
    async fn remove_descriptions(&self, keys: &[Digest]) -> Result<usize, StoreError>;

    /// Acquires the right to buy the description with this key, so that no two processes pay for the
    /// same one, or to do other work that is known by a key. The lease expires at `until`. Returns `false` while another
    /// process holds it.
    ///
    /// A store with a single process always grants it.
    async fn acquire_lease(&self, key: &Digest, until: Timestamp) -> Result<bool, StoreError> {
        let _ = (key, until);
        Ok(true)
    }
    /// Releases the lease of this process without the work having been done.
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
