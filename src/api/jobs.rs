//! Jobs: pages, events, and matching regions of a pair.

use serde::Serialize;
use utoipa::ToSchema;
use uuid::Uuid;
use whereabouts_core::{Description, Job, JobState, MapName, PairRegion};

/// A page of jobs, newest first.
#[derive(Debug, Serialize, ToSchema)]
pub struct JobPage {
    /// Jobs on this page.
    pub jobs: Vec<Job>,
    /// `cursor=` of the request for the next page; null on the last page. A search (`q=`) examines a few
    /// thousand jobs per page, so a page may be short or even empty without being the last.
    pub next_cursor: Option<Uuid>,
}

/// Matching regions of a frame and a reference image, most significant first.
#[derive(Debug, Serialize, ToSchema)]
pub struct PairRegions {
    /// Pairs of matching regions.
    pub regions: Vec<PairRegion>,
}

/// The state of a job.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct JobStatus {
    /// State of the job.
    pub state: JobState,
    /// How often a worker has claimed the job.
    pub attempts: u32,
    /// Why the job failed or was degraded, or why it was queued again.
    pub error: Option<String>,
}

/// A pair of a job has been described.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct PairDescribed {
    /// Pairs described so far.
    pub described: usize,
    /// Number of pairs of the job.
    pub of: usize,
    /// Description of the pair.
    pub description: Description,
}

/// A job has progressed or finished.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct JobChange {
    /// Id of the job.
    pub id: Uuid,
    /// Map of the job.
    pub map: MapName,
    /// State of the job.
    pub state: JobState,
    /// How often a worker has claimed the job.
    pub attempts: u32,
    /// Pairs described so far.
    pub described: usize,
    /// Number of pairs of the job.
    pub of: usize,
    /// Why the job failed or was degraded, or why it was queued again.
    pub error: Option<String>,
}

/// Events that were dropped because the client was too slow to receive them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
pub struct Missed {
    /// Number of dropped events. `GET /jobs` returns the current state of the jobs.
    pub changes: u64,
}
