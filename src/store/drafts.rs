//! Reindexing: a draft collects new descriptors while the current ones keep serving.

use async_trait::async_trait;

use super::StoreError;
use whereabouts_core::{Descriptor, Image, Map};

/// Creates drafts.
#[async_trait]
pub trait DraftStore: Send + Sync {
    /// Begins a draft of the next revision of a map; `next` is the map as it will be.
    ///
    /// # Errors
    /// [`StoreError::Conflict`] while the map has another draft.
    async fn draft(&self, next: Map) -> Result<Box<dyn Draft>, StoreError>;
}

/// New descriptors for all images of a map, which replace the current ones in one step.
///
/// Images may be added and removed in the meantime. A draft does not survive its process.
#[async_trait]
pub trait Draft: Send + Sync {
    /// Returns up to `limit` images without a descriptor in the draft; an empty list means that the
    /// draft is complete. Each image must be passed to [`Self::write`] before the next call.
    async fn missing(&mut self, limit: usize) -> Result<Vec<Image>, StoreError>;
    /// Stores the descriptor of an image, unless the image was removed in the meantime.
    async fn write(&mut self, image: &Image, descriptor: Descriptor) -> Result<(), StoreError>;
    /// Atomically replaces the map's descriptors with the draft. Returns `false`, and changes
    /// nothing, if images without a descriptor were added in the meantime.
    async fn replace(&mut self) -> Result<bool, StoreError>;
    /// Deletes an abandoned draft.
    async fn discard(self: Box<Self>);
}
