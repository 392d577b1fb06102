//! The cache of pairwise descriptions: paid for once, kept until evicted.

use async_trait::async_trait;
use jiff::Timestamp;
use uuid::Uuid;

use whereabouts_core::{
    CacheLevels, CachedDescription, DescribedFrame, Descriptor, Digest, SimilarFrame,
};

use crate::StoreError;

/// Descriptions by key. A key covers all that shapes the text: both pictures, the prompt, the model
/// and its sampling.
#[async_trait]
pub trait DescriptionCache: Send + Sync {
    /// The description of that key, if it is kept.
    async fn description(&self, key: &Digest) -> Result<Option<CachedDescription>, StoreError>;
    /// Keeps a description; it is on disk when this returns.
    async fn keep_description(
        &self,
        key: Digest,
        value: CachedDescription,
    ) -> Result<(), StoreError>;

    /// Says that this process is about to buy the description of that key, until that moment at the
    /// latest; `false` if another process is at it, whose description will soon be kept. Only stores of many
    /// processes need to know.
    async fn acquire_lease(&self, key: &Digest, until: Timestamp) -> Result<bool, StoreError> {
        let _ = (key, until);
        Ok(true)
    }
    /// Says that nothing came of it.
    async fn release_lease(&self, key: &Digest) -> Result<(), StoreError> {
        let _ = key;
        Ok(())
    }

    /// Earlier frames of the map that are as similar as `at_least` (cosine), the most similar
    /// first; no more than a few.
    async fn similar_frames(
        &self,
        map: Uuid,
        to: &Descriptor,
        at_least: f32,
    ) -> Result<Vec<SimilarFrame>, StoreError>;
    /// Remembers a frame of the map whose pairs were described; the oldest beyond `most` are
    /// forgotten.
    async fn keep_frame(
        &self,
        map: Uuid,
        frame: DescribedFrame,
        most: usize,
    ) -> Result<(), StoreError>;

    /// How full it is.
    fn levels(&self) -> CacheLevels;
}
