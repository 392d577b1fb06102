//! Localization: the answer to a frame.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;
use whereabouts_core::{Candidate, Estimate, ImageId, JobState, MapName, Pose};

/// What becomes of the candidates after the first answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RefineMode {
    /// A job refines them; the answer does not wait.
    #[default]
    Async,
    /// A job refines them; the answer waits for it, and its estimate follows the refined order.
    Wait,
    /// Nothing.
    Off,
}

/// Where the frame was probably taken.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Answer {
    /// The id of this query.
    pub query_id: Uuid,
    /// The map.
    pub map: MapName,
    /// The model that made the descriptor.
    pub model: String,
    /// The most similar images, best first.
    pub candidates: Vec<Candidate>,
    /// The best guess; null in an empty map.
    #[schema(nullable)]
    pub estimate: Option<Estimate>,
    /// Where the robot is, given all frames of its track; null for a frame of none.
    #[serde(default)]
    #[schema(nullable)]
    pub track: Option<TrackEstimate>,
    /// The refinement; null if there is none.
    #[schema(nullable)]
    pub job: Option<JobLink>,
    /// Why there is no refinement, if one was asked for; else null.
    #[serde(default)]
    #[schema(nullable)]
    pub no_job: Option<NoJob>,
    /// How long the stages took.
    pub timing_ms: TimingMs,
}

/// Where to find a job.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct JobLink {
    /// Its id.
    pub id: Uuid,
    /// Its address.
    pub href: String,
    /// How far it has come.
    pub state: JobState,
}

/// How long the stages of an answer took, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize, ToSchema)]
pub struct TimingMs {
    /// Decoding and resizing.
    pub decode: f64,
    /// Inference and pooling, including the wait for a free session.
    pub extract: f64,
    /// Search.
    pub search: f64,
    /// Everything until the answer, including the wait for a free thread and for the disk.
    pub total: f64,
}

/// Why an answer has no job, although one was asked for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct NoJob {
    /// The reason, for programs.
    pub reason: NoJobReason,
    /// What happened and what to do next.
    pub detail: String,
}

/// Why there is no job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoJobReason {
    /// The server refines nothing.
    NoRefiner,
    /// The map has no images to compare with.
    EmptyMap,
    /// As many jobs wait or run as may (`jobs.queue`).
    QueueFull,
    /// So many pictures wait that no frame gets a job (`jobs.shed_at`).
    Overload,
    /// The disk has no room for the frame (`data.min_free_bytes`).
    DiskFull,
}

impl NoJob {
    /// A reason with its explanation.
    pub fn new(reason: NoJobReason, detail: impl Into<String>) -> Self {
        Self { reason, detail: detail.into() }
    }

    /// Whether the job was shed because of load, so that a later frame may get one.
    pub fn is_shedding(&self) -> bool {
        matches!(self.reason, NoJobReason::QueueFull | NoJobReason::Overload)
    }
}

/// Where the robot is, given all frames of its track.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackEstimate {
    /// The track.
    pub id: String,
    /// Its frames so far, this one included.
    pub frames: u64,
    /// The most probable image; null as long as no image with a pose is likely.
    #[schema(nullable)]
    pub image_id: Option<ImageId>,
    /// Its pose.
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// The probability that the robot is within the size of a place (`confidence.place_m`) of that
    /// image, 0 to 1, as far as the motion and the share of useless frames are as they are set.
    pub probability: f64,
    /// Whether the probability reaches the configured bound.
    pub known: bool,
}
