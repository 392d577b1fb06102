//! Idempotency keys: the first response to a request is stored and replayed to its retries.

use async_trait::async_trait;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::StoreError;
use whereabouts_core::Digest;

/// The state of a request that carries an idempotency key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IdempotencyRecord {
    /// Digest of the request. A retry must have the same one.
    pub fingerprint: Digest,
    /// When the request was reserved or, later, answered.
    pub at: Timestamp,
    /// How far the request has got.
    pub progress: Progress,
}

/// How far a request with an idempotency key has got.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Progress {
    /// A process is handling it.
    Running {
        /// The process that reserved the request.
        process: Uuid,
        /// The job queued for this request, by this process or by an earlier one that ended before
        /// it could answer.
        #[serde(default)]
        job: Option<Uuid>,
    },
    /// It was answered with this response.
    Answered(StoredResponse),
}

/// A response that is replayed to retries.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoredResponse {
    /// The HTTP status.
    pub status: u16,
    /// The media type of the body.
    pub content_type: Option<String>,
    /// The body.
    pub body: String,
}

/// Requests with idempotency keys, and their responses.
#[async_trait]
pub trait IdempotencyStore: Send + Sync {
    /// Reserves a request, or returns the record of an earlier one with the same id.
    ///
    /// An earlier record does not count if it is older than `since` or belongs to a process that has
    /// ended. Disposition `reserved` replaces it, inherits the job queued for it, and `None` is returned.
    async fn reserve_request(
        &self,
        id: &str,
        reserved: IdempotencyRecord,
        since: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError>;
    /// Stores the record of an answered request.
    async fn store_response(&self, id: &str, answer: IdempotencyRecord) -> Result<(), StoreError>;
    /// Deletes the record of a request.
    async fn forget_request(&self, id: &str) -> Result<(), StoreError>;
    /// Deletes the records from before a moment, and the oldest of those in excess of `max_records`.
    /// Returns the number deleted.
    async fn prune_responses(
        &self,
        before: Timestamp,
        max_records: usize,
    ) -> Result<usize, StoreError>;
}
