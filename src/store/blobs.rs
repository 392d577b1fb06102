//! Image bytes, addressed by their digest.

use async_trait::async_trait;
use bytes::Bytes;

use super::StoreError;
use whereabouts_core::Digest;

/// Image bytes, by digest.
#[async_trait]
pub trait BlobStore: Send + Sync {
    /// Stores bytes. They are kept at least until the returned pin is dropped, and after that for as
    /// long as an image, a query or the vocabulary of a map refers to them.
    async fn put_blob(&self, digest: Digest, bytes: Bytes) -> Result<BlobPin, StoreError>;
    /// Returns the bytes of this digest.
    async fn blob(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError>;
}

/// Protects new bytes from garbage collection until a record refers to them.
pub type BlobPin = Box<dyn std::any::Any + Send>;
