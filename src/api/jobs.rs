//! Jobs: pages of them, their events, and the regions that two pictures share.

use serde::Serialize;
use utoipa::ToSchema;
use uuid::Uuid;
use whereabouts_core::{Description, Job, JobState, MapName, PairRegion};

/// Some jobs, newest first.
#[derive(Debug, Serialize, ToSchema)]
pub struct JobPage {
    /// The jobs.
    pub jobs: Vec<Job>,
    /// Where the next page starts: `cursor=` of the next request. Null on the last page. A search (`q=`)
    /// looks at some thousand jobs for one page, so that a page may be short, even empty, and yet not be
    /// the last.
    pub next_cursor: Option<Uuid>,
}

/// The regions that two pictures have in common, the most telling first.
#[derive(Debug, Serialize, ToSchema)]
pub struct PairRegions {
    /// The pairs of regions.
    pub regions: Vec<PairRegion>,
}

/// How far a job has come.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct JobStatus {
    /// Its state.
    pub state: JobState,
    /// How often a worker has taken it.
    pub attempts: u32,
    /// What went wrong, or what it waits for.
    pub error: Option<String>,
}

/// One more pair of a job is described.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct PairDescribed {
    /// Pairs described so far.
    pub described: usize,
    /// Pairs of the job.
    pub of: usize,
    /// The pair.
    pub description: Description,
}

/// A job has come further, or has ended.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct JobChange {
    /// The job.
    pub id: Uuid,
    /// Its map.
    pub map: MapName,
    /// Its state.
    pub state: JobState,
    /// How often a worker has taken it.
    pub attempts: u32,
    /// Pairs described so far.
    pub described: usize,
    /// Pairs of the job.
    pub of: usize,
    /// What went wrong, or what it waits for.
    pub error: Option<String>,
}

/// Changes that were not told, because they came faster than they were taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
pub struct Missed {
    /// How many. `GET /jobs` says how the jobs are now.
    pub changes: u64,
}
