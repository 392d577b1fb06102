//! The errors of a store.

use whereabouts_core::MapName;

/// Why a call to a store failed.
///
/// The error can be cloned, so that every change of a commit that failed gets the same one.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// The record does not exist.
    #[error("{0}")]
    NotFound(String),
    /// The change contradicts the stored state.
    #[error("{0}")]
    Conflict(String),
    /// The map was reindexed, or its coordinate frame changed, after the caller read it.
    #[error(
        "the descriptors or the coordinate frame of the map {0} were replaced meanwhile; try again"
    )]
    Superseded(MapName),
    /// The job queue has reached its bound.
    #[error("the refinement queue is full: it holds {limit} jobs (jobs.queue)")]
    QueueFull {
        /// The bound.
        limit: usize,
    },
    /// Storing the bytes would leave less free disk space than is reserved.
    #[error(
        "the disk of the data folder is full: {free} bytes are free, and data.min_free_bytes reserves \
         {kept} of them; free some space, or delete images or maps"
    )]
    Full {
        /// Free bytes.
        free: u64,
        /// Bytes that must stay free.
        kept: u64,
    },
    /// The database or the object store cannot be reached or is too busy. The call may be retried.
    #[error("{0}")]
    Unavailable(String),
    /// The disk or the database failed. A retry is not expected to help.
    #[error("the store failed: {0}")]
    Failed(String),
    /// Stored data cannot be read, or is not what was written.
    #[error("the store is damaged: {0}")]
    Damaged(String),
}
