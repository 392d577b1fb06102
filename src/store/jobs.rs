//! Jobs and their queue.

use std::sync::Arc;

use async_trait::async_trait;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use tokio::sync::broadcast;
use uuid::Uuid;

use super::{JobFilter, JobList, MapStore, StoreError};
use whereabouts_core::{
    Calibration, Candidate, Description, Descriptor, Digest, Job, JobState, Map, MediaType, Usage,
};

/// A frame that a robot posted, kept because a job needs it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Query {
    /// The id of the query.
    pub id: Uuid,
    /// The digest of the frame.
    pub digest: Digest,
    /// The frame's format.
    pub media_type: MediaType,
    /// When it was received.
    pub created_at: Timestamp,
    /// The frame's descriptor, if the refiner needs it.
    #[serde(default)]
    pub descriptor: Option<Descriptor>,
    /// Why the frame cannot show a known place, if it cannot.
    #[serde(default)]
    pub uninformative: Option<String>,
}

/// A job together with what its worker needs.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct JobRecord {
    /// The job as the API returns it.
    pub job: Job,
    /// Distinguishes the map from a later one of the same name.
    pub map_uid: Uuid,
    /// The revision of the map that the query was searched in; its descriptor belongs to this one.
    #[serde(default)]
    pub revision: u32,
    /// The query.
    pub query: Query,
    /// The candidates in coarse order.
    pub candidates: Vec<Candidate>,
    /// How often a worker has claimed the job, whatever the result.
    #[serde(default)]
    pub claims: u32,
    /// The trace context of the request (W3C), the parent of the refinement's span.
    #[serde(default)]
    pub traceparent: Option<String>,
}

/// One worker's claim to a job. It ends when the job is cancelled, or when its lease expires and another
/// worker claims the job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim {
    /// The job.
    pub job: Uuid,
    /// Counts the claims of this job.
    number: u32,
}

impl JobRecord {
    /// Returns the claim of the worker that received this record.
    pub fn claim(&self) -> Claim {
        Claim { job: self.job.id, number: self.claims }
    }

    /// Whether this claim still holds.
    pub fn is_held_by(&self, claim: Claim) -> bool {
        self.job.state == JobState::Running && self.claim() == claim
    }

    /// Returns the map that the job is about; `None` if it was removed, even if another has its name now.
    pub async fn map(&self, maps: &dyn MapStore) -> Result<Option<Map>, StoreError> {
        let map = maps.map(&self.job.map).await?;
        Ok(map.filter(|map| map.uid == self.map_uid))
    }

    /// Returns the calibration of that map, if there is one.
    pub async fn calibration(
        &self,
        maps: &dyn MapStore,
    ) -> Result<Option<Arc<Calibration>>, StoreError> {
        match self.map(maps).await? {
            Some(map) => maps.calibration(&map).await,
            None => Ok(None),
        }
    }
}

/// A completed step of a running job.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The cost of the step.
    pub usage: Usage,
    /// The description of a pair, if the step produced one.
    pub description: Option<Description>,
}

/// How a claimed job returns to the queue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Release {
    /// The reason, shown as the job's error.
    pub why: String,
    /// The job cannot be claimed before this moment.
    pub not_before: Option<Timestamp>,
    /// Whether the attempt counts against the limit of attempts.
    pub counts: bool,
}

/// Jobs and their queue.
#[async_trait]
pub trait JobStore: Send + Sync {
    /// Queues a job unless `limit` jobs are already queued or running ([`StoreError::QueueFull`]).
    async fn submit(&self, record: JobRecord, limit: usize) -> Result<(), StoreError>;
    /// Queues a job for a request that was reserved under this id
    /// ([`IdempotencyStore::reserve_request`]), and records it there in the same transaction. If an
    /// earlier process queued a job for the request and ended before it could answer, returns that job
    /// and queues nothing.
    ///
    /// [`IdempotencyStore::reserve_request`]: super::IdempotencyStore::reserve_request
    async fn submit_once(
        &self,
        record: JobRecord,
        limit: usize,
        request: &str,
    ) -> Result<Option<Job>, StoreError>;
    /// Returns the number of jobs that are queued or running.
    async fn queued(&self) -> Result<usize, StoreError>;
    /// Returns when the oldest unfinished job was submitted.
    async fn oldest_unfinished(&self) -> Result<Option<Timestamp>, StoreError>;
    /// Returns one job.
    async fn job(&self, id: Uuid) -> Result<Option<JobRecord>, StoreError>;
    /// Returns up to `limit` jobs older than `before`, newest first. A text search examines a bounded
    /// number of jobs; [`JobList::searched_to`] says where it stopped.
    async fn jobs(
        &self,
        filter: &JobFilter,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<JobList, StoreError>;
    /// Claims, until `lease_until`, the oldest job of the highest priority among those that are queued
    /// or whose lease has expired.
    async fn claim(
        &self,
        now: Timestamp,
        lease_until: Timestamp,
    ) -> Result<Option<JobRecord>, StoreError>;
    /// Adds the cost of a step to a claimed job, and its description, which replaces an earlier one of
    /// the same image. Does nothing if the claim has ended.
    async fn progress(&self, claim: Claim, step: Step) -> Result<(), StoreError>;
    /// Returns a claimed job to the queue. Does nothing if the claim has ended.
    async fn release(&self, claim: Claim, release: Release) -> Result<(), StoreError>;
    /// Ends a claimed job with its worker's result. Does nothing if the claim has ended.
    async fn finish(&self, claim: Claim, job: Job) -> Result<(), StoreError>;
    /// Cancels a job that has not ended, and returns its new state.
    async fn cancel(&self, id: Uuid) -> Result<Job, StoreError>;
    /// Queues a failed, cancelled or degraded job again, with its attempts and cost reset to zero.
    ///
    /// With `fresh_since`, any job that has ended is queued again, and descriptions from before that time are
    /// bought again.
    async fn retry(&self, id: Uuid, fresh_since: Option<Timestamp>) -> Result<Job, StoreError>;
    /// Returns a receiver of the ids of jobs as they change. A slow receiver misses the oldest ones.
    fn changes(&self) -> broadcast::Receiver<Uuid>;
}
