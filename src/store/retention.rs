//! Retention: deleting what has expired.

use async_trait::async_trait;
use jiff::Timestamp;
use jiff::civil::Date;

use super::StoreError;
use whereabouts_core::MapName;

/// Which ended jobs to keep. A job is removed together with its query and its frame.
#[derive(Debug, Clone, Copy)]
pub struct JobRetention {
    /// Removes jobs that ended before this moment.
    pub since: Option<Timestamp>,
    /// Keeps at most this many ended jobs; those that ended first are removed first.
    pub most: Option<usize>,
    /// Keeps jobs that ended after this moment, whatever the two bounds above say.
    pub settled: Timestamp,
}

/// What a call to [`Retention::remove_ended`] removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RemovedJobs {
    /// Jobs that had expired.
    pub by_age: usize,
    /// Jobs in excess of the maximum.
    pub by_count: usize,
    /// Bytes of frames that were left without a reference.
    pub bytes: u64,
}

impl RemovedJobs {
    /// Number of jobs removed.
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

/// Deletes expired records, collects garbage and reports sizes.
#[async_trait]
pub trait Retention: Send + Sync {
    /// Removes up to `batch` ended jobs that need not be kept. Small batches keep other writes from
    /// waiting long.
    async fn remove_ended(
        &self,
        keep: JobRetention,
        batch: usize,
    ) -> Result<RemovedJobs, StoreError>;
    /// Deletes the usage of days before this one.
    async fn forget_usage(&self, before: Date) -> Result<(), StoreError>;
    /// Deletes what processes that ended left behind, and evicts descriptions beyond their bounds.
    async fn collect_garbage(&self) -> Result<(), StoreError>;
    /// Returns the size of the database's files, in bytes.
    async fn db_bytes(&self) -> Result<u64, StoreError>;
    /// Returns the size of each map's descriptors and their index, in bytes.
    async fn index_bytes(&self) -> Result<Vec<(MapName, u64)>, StoreError>;
    /// Returns the free bytes where pictures are stored; `None` if that is unknown.
    async fn free_bytes(&self) -> Option<u64>;
}
