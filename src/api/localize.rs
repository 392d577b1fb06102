//! Localization of a frame.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;
use whereabouts_core::{Candidate, Estimate, ImageId, JobState, MapName, Pose, Ranking};

/// How the candidates are refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RefineMode {
    /// A job refines the candidates; the response does not wait for it.
    #[default]
    Async,
    /// A job refines the candidates; the response waits for it, and its estimate is based on the refined order.
    Wait,
    /// The candidates are not refined.
    Off,
}

/// Where the frame was probably taken.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Answer {
    /// Id of the query.
    pub query_id: Uuid,
    /// Map that was searched.
    pub map: MapName,
    /// Model that computed the descriptor.
    pub model: String,
    /// The most similar images, best first, whether or not they are refined.
    pub candidates: Vec<Candidate>,
    /// The most likely place; null in an empty map.
    #[schema(nullable)]
    pub estimate: Option<Estimate>,
    /// Position of the robot based on all frames of its track; null if the frame belongs to no track.
    #[serde(default)]
    #[schema(nullable)]
    pub track: Option<TrackEstimate>,
    /// The refinement job; null if there is none.
    #[schema(nullable)]
    pub job: Option<JobLink>,
    /// With `refine=wait`, the refined order of the candidates once the job has ended, to which `estimate` belongs;
    /// otherwise null. It may have more candidates than the answer.
    #[serde(default)]
    #[schema(nullable)]
    pub ranking: Option<Ranking>,
    /// Why there is no job although one was requested; otherwise null.
    #[serde(default)]
    #[schema(nullable)]
    pub no_job: Option<NoJob>,
    /// What the sender should know about the frame, such as damage in transit; usually empty.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// Durations of the stages.
    pub timing_ms: TimingMs,
}

/// A reference to a job.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct JobLink {
    /// Id of the job.
    pub id: Uuid,
    /// Path of the job.
    pub href: String,
    /// State of the job.
    pub state: JobState,
}

/// Durations of the stages of a localization in milliseconds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize, ToSchema)]
pub struct TimingMs {
    /// Decoding and resizing.
    pub decode: f64,
    /// Inference and pooling, including queueing for a session.
    pub extract: f64,
    /// Search.
    pub search: f64,
    /// Total until the response, including queueing and disk writes.
    pub total: f64,
}

/// Why a response has no job although one was requested.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct NoJob {
    /// Machine-readable reason.
    pub reason: NoJobReason,
    /// What happened and what to do next.
    pub detail: String,
}

/// Why there is no job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoJobReason {
    /// Refinement is disabled on the server.
    NoRefiner,
    /// The map has no images.
    EmptyMap,
    /// The job queue is full (`jobs.queue`).
    QueueFull,
    /// Jobs are shed because too many pictures are waiting (`jobs.shed_at`).
    Overload,
    /// The disk has no room for the frame (`data.min_free_bytes`).
    DiskFull,
}

impl NoJob {
    /// Combines a reason with its explanation.
    pub fn new(reason: NoJobReason, detail: impl Into<String>) -> Self {
        Self { reason, detail: detail.into() }
    }

    /// Whether the job was shed because of load, so that a later frame may get one.
    pub fn is_shedding(&self) -> bool {
        matches!(self.reason, NoJobReason::QueueFull | NoJobReason::Overload)
    }
}

/// Position of a robot, based on all frames of its track.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackEstimate {
    /// Id of the track.
    pub id: String,
    /// Number of frames so far, including this one.
    pub frames: u64,
    /// Most probable image; null while no image with a pose is likely.
    #[schema(nullable)]
    pub image_id: Option<ImageId>,
    /// Pose of that image.
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// Probability, 0 to 1, that the robot is at that image or one next to it: within 2.5 times the usual distance of
    /// neighbouring images, and within `confidence.place_m`.
    pub probability: f64,
    /// Whether the probability reaches the configured threshold.
    pub known: bool,
    /// Probability, 0 to 1, that the robot is at no place of the map: `probability` is that of being on the map and at
    /// that image.
    #[serde(default)]
    pub off_map: f64,
    /// Up to two other places where the robot may be, each with a probability of at least 0.1; the most probable first.
    #[serde(default)]
    pub others: Vec<TrackHypothesis>,
    /// Whether the frame is older than the last one of the track. The estimate is for its own time, and the track
    /// continues from the last one.
    #[serde(default)]
    pub is_late: bool,
}

/// A place where a robot may be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackHypothesis {
    /// The image of the place.
    pub image_id: ImageId,
    /// Pose of that image.
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// Probability, 0 to 1, that the robot is there.
    pub probability: f64,
}
