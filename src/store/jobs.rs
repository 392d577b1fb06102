//! What a store promises of jobs.

use async_trait::async_trait;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use tokio::sync::broadcast;
use uuid::Uuid;

use super::{JobFilter, JobList, StoreError};
use whereabouts_core::{
    Candidate, Description, Descriptor, Digest, Job, JobState, MediaType, Usage,
};

/// What a robot posted, kept because a job needs it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Query {
    /// Its id.
    pub id: Uuid,
    /// The digest of the frame.
    pub digest: Digest,
    /// The frame's format.
    pub media_type: MediaType,
    /// When it came.
    pub created_at: Timestamp,
    /// The frame's descriptor, where the refiner wants it.
    #[serde(default)]
    pub descriptor: Option<Descriptor>,
}

/// A job with what its worker needs.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct JobRecord {
    /// What callers see.
    pub job: Job,
    /// Tells the map from a later one of the same name.
    pub map_uid: Uuid,
    /// The revision of the map whose descriptors the query's is like.
    #[serde(default)]
    pub revision: u32,
    /// The query.
    pub query: Query,
    /// The candidates in coarse order.
    pub candidates: Vec<Candidate>,
    /// How often a worker has claimed it, whatever became of that.
    #[serde(default)]
    pub claims: u32,
    /// The trace of its request, for the span of its refinement (W3C Trace Context).
    #[serde(default)]
    pub traceparent: Option<String>,
}

/// The right of one worker to a job, which ends when the job is cancelled, or when its lease runs out
/// and another worker claims it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim {
    /// The job.
    pub job: Uuid,
    /// Which of its claims.
    number: u32,
}

impl JobRecord {
    /// The claim of the worker that this record was given to.
    pub fn claim(&self) -> Claim {
        Claim { job: self.job.id, number: self.claims }
    }

    /// Whether the job is still that worker's.
    pub fn is_held_by(&self, claim: Claim) -> bool {
        self.job.state == JobState::Running && self.claim() == claim
    }
}

/// A step of a job that runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// What the step cost.
    pub usage: Usage,
    /// The pair that is described now, if the step was that.
    pub description: Option<Description>,
}

/// How a claimed job goes back to the queue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Release {
    /// Why.
    pub why: String,
    /// Nobody takes it before then.
    pub not_before: Option<Timestamp>,
    /// Whether the attempt counts.
    pub counts: bool,
}

/// Jobs and their queue.
#[async_trait]
pub trait JobStore: Send + Sync {
    /// Queues a job unless `limit` jobs wait already ([`StoreError::QueueFull`]).
    async fn submit(&self, record: JobRecord, limit: usize) -> Result<(), StoreError>;
    /// The same for a request that was reserved with that id ([`super::IdempotencyStore::reserve_answer`]); the
    /// job and the note that it was queued for this request are one change. If one was queued for it before, by a
    /// process that ended too soon to answer, gives that one and queues nothing.
    async fn submit_once(
        &self,
        record: JobRecord,
        limit: usize,
        request: &str,
    ) -> Result<Option<Job>, StoreError>;
    /// Jobs that wait.
    async fn queued(&self) -> Result<usize, StoreError>;
    /// When the oldest job that has not ended was submitted.
    async fn oldest_open(&self) -> Result<Option<Timestamp>, StoreError>;
    /// One job.
    async fn job(&self, id: Uuid) -> Result<Option<JobRecord>, StoreError>;
    /// Jobs, newest first, those older than `before`, at most `limit`. A search for a text may look at a
    /// bounded number of jobs only, and says so.
    async fn jobs(
        &self,
        filter: &JobFilter,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<JobList, StoreError>;
    /// Takes, until `lease_until`, a job that waits or whose lease ran out: one of the highest
    /// priority, and of those the oldest.
    async fn claim(
        &self,
        now: Timestamp,
        lease_until: Timestamp,
    ) -> Result<Option<JobRecord>, StoreError>;
    /// Adds a step to a claimed job: its cost, and its description in the place of one of the same
    /// image.
    async fn progress(&self, claim: Claim, step: Step) -> Result<(), StoreError>;
    /// Gives a claimed job back to the queue.
    async fn release(&self, claim: Claim, release: Release) -> Result<(), StoreError>;
    /// Ends a claimed job with what its worker found. As with the two above, nothing happens to a job
    /// that is no longer that worker's.
    async fn finish(&self, claim: Claim, job: Job) -> Result<(), StoreError>;
    /// Cancels a job that has not ended; returns it as it then is.
    async fn cancel(&self, id: Uuid) -> Result<Job, StoreError>;
    /// Queues a job again that ended without success. Its attempts and its cost begin anew.
    async fn retry(&self, id: Uuid) -> Result<Job, StoreError>;
    /// The ids of jobs that changed, as they change. A slow listener loses the oldest.
    fn changes(&self) -> broadcast::Receiver<Uuid>;
}
