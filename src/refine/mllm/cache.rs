//! Descriptions that were paid for, kept so that none is bought twice.

use async_trait::async_trait;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::domain::{Digest, Usage};
use crate::store::StoreError;

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
}

/// A description as it was bought.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CachedDescription {
    /// What agrees and what differs, in words.
    pub text: String,
    /// What the call cost.
    pub usage: Usage,
    /// When it was made.
    pub created_at: Timestamp,
}
