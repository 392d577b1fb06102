//! Jobs: each refines the candidates of one query.

use std::fmt;
use std::ops::{Add, AddAssign};
use std::str::FromStr;

use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use super::map::display_as_written;
use super::{
    Calibration, Candidate, Certainty, Estimate, Evidence, ImageId, InvalidName, MapName, Ranking,
    TextLine,
};

/// The method that refines candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RefinerKind {
    /// Geometric matching of dense features, computed locally.
    #[default]
    Local,
    /// `local` first, and a multimodal LLM only where its answer is in question.
    Cascade,
    /// A multimodal LLM.
    Mllm,
}

impl RefinerKind {
    /// Returns the refiner's place in the order of cost: one that comes later may cost more.
    pub fn cost(self) -> u8 {
        match self {
            Self::Local => 0,
            Self::Cascade => 1,
            Self::Mllm => 2,
        }
    }
}

/// The state of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waiting for a worker.
    Queued,
    /// A worker is processing it.
    Running,
    /// Finished with a ranking.
    Succeeded,
    /// Finished with a ranking of which a part fell back to the coarse order; `error` says why.
    Degraded,
    /// Finished without a ranking; `error` says why.
    Failed,
    /// Cancelled by a caller.
    Cancelled,
}

/// Scheduling priority. Jobs of higher priority run first; jobs of equal priority run oldest first.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Priority {
    /// Runs when no other job is waiting.
    Low,
    /// The default.
    #[default]
    Normal,
    /// Runs before all others.
    High,
}

display_as_written!(Priority { Low => "low", Normal => "normal", High => "high" });
display_as_written!(RefinerKind { Local => "local", Cascade => "cascade", Mllm => "mllm" });
display_as_written!(JobState {
    Queued => "queued",
    Running => "running",
    Succeeded => "succeeded",
    Degraded => "degraded",
    Failed => "failed",
    Cancelled => "cancelled"
});

impl JobState {
    /// Whether the job is finished and will not change any more.
    pub fn is_final(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }
}

/// The text that compares the query with one candidate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Description {
    /// Id of the candidate's image.
    pub image_id: ImageId,
    /// Similarities and differences of the pair.
    pub text: String,
    /// Whether the text came from the description cache.
    pub cached: bool,
    /// The earlier, nearly identical frame for which the text was written; null if it was written for
    /// this frame.
    #[serde(default)]
    #[schema(nullable)]
    pub stands_in: Option<StandIn>,
    /// Milliseconds the model took to write the text. For `mllm`: the duration of the successful request,
    /// excluding queueing and failed attempts. For `local`, which compares all pairs together: an equal
    /// share of the total. Null for a cached text.
    #[serde(default)]
    pub took_ms: Option<u64>,
    /// Cost of the text.
    pub usage: Usage,
}

/// An earlier, nearly identical frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StandIn {
    /// The query that posted the earlier frame.
    pub query_id: Uuid,
    /// Cosine similarity of the two frames' descriptors, −1 to 1.
    pub similarity: f32,
}

/// What one of the refiners of a cascade found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobVerdict {
    /// The refiner.
    pub refiner: RefinerKind,
    /// The image that it puts first.
    pub image_id: ImageId,
    /// The calibrated confidence that this image shows the place; null while it is not measured yet.
    #[serde(default)]
    pub confidence: Option<f32>,
    /// What the confidence will be computed from, where the similarity of the candidates is not enough. Only while the
    /// confidence is null.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(nullable)]
    pub evidence: Option<Evidence>,
    /// How certain a model says it is; null for `local`.
    #[serde(default)]
    #[schema(nullable)]
    pub certainty: Option<Certainty>,
    /// Number of candidates that it compared.
    pub compared: usize,
    /// Whether the answer stands or goes on to the model, and why; null for the last verdict.
    #[serde(default)]
    pub then: Option<String>,
}

/// Model calls and tokens used by a refinement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct Usage {
    /// Calls to an external model.
    pub calls: u32,
    /// Descriptions served from the cache.
    pub cached: u32,
    /// Prompt tokens.
    pub prompt_tokens: u64,
    /// Completion tokens.
    pub completion_tokens: u64,
    /// Calls whose tokens are estimated because the model's server did not report them.
    #[serde(default)]
    pub estimated: u32,
}

impl Add for Usage {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            calls: self.calls.saturating_add(other.calls),
            cached: self.cached.saturating_add(other.cached),
            prompt_tokens: self.prompt_tokens.saturating_add(other.prompt_tokens),
            completion_tokens: self.completion_tokens.saturating_add(other.completion_tokens),
            estimated: self.estimated.saturating_add(other.estimated),
        }
    }
}

impl AddAssign for Usage {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// The UTC date of a timestamp. Budgets and usage are counted per UTC day.
pub fn utc_day(at: Timestamp) -> Date {
    at.to_zoned(TimeZone::UTC).date()
}

/// Usage and cost of refinement in one map on one day.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DayUsage {
    /// UTC date.
    pub date: Date,
    /// Name of the map.
    pub map: MapName,
    /// The calls and their tokens.
    pub usage: Usage,
    /// Cost in the currency of the configured prices, at the prices in effect at the time.
    pub money: f64,
}

/// A refinement job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Job {
    /// Id of the job. Ids sort by creation time.
    pub id: Uuid,
    /// Map that was queried.
    pub map: MapName,
    /// Id of the query.
    pub query_id: Uuid,
    /// Refinement method.
    pub refiner: RefinerKind,
    /// Scheduling priority.
    #[serde(default)]
    pub priority: Priority,
    /// State of the job.
    pub state: JobState,
    /// When the job was queued.
    pub created_at: Timestamp,
    /// When a worker first claimed the job.
    pub started_at: Option<Timestamp>,
    /// When the job finished.
    pub finished_at: Option<Timestamp>,
    /// How often a worker has claimed the job.
    pub attempts: u32,
    /// One description per candidate compared so far, in coarse order.
    pub descriptions: Vec<Description>,
    /// The refined order; null until the job has one.
    #[schema(nullable)]
    pub ranking: Option<Ranking>,
    /// The model's explanation of the ranking.
    pub reasoning: Option<String>,
    /// Milliseconds that the ranking call took, measured like those of a description. Null if there was no
    /// such call; `local` makes none.
    #[serde(default)]
    pub reasoning_took_ms: Option<u64>,
    /// Where the frame was probably taken, based on the refined order; null until the job has one.
    #[serde(default)]
    #[schema(nullable)]
    pub estimate: Option<Estimate>,
    /// The lines of text in the frame, from top to bottom; null if they were not read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(nullable)]
    pub texts: Option<Vec<TextLine>>,
    /// The verdicts of a job of `cascade`, in order: that of `local`, and that of the model if it was asked.
    #[serde(default)]
    pub verdicts: Vec<JobVerdict>,
    /// Descriptions from before this time are bought again; null if cached ones of any age are used.
    #[serde(default)]
    #[schema(nullable)]
    pub fresh_since: Option<Timestamp>,
    /// Usage of all attempts since the job was queued or last retried.
    pub usage: Usage,
    /// Why the job failed or was degraded, or why it was queued again.
    pub error: Option<String>,
    /// Id of the trace that covers the request and the refinement (W3C Trace Context), if tracing is enabled.
    #[serde(default)]
    #[schema(nullable)]
    pub trace_id: Option<String>,
}

impl JobVerdict {
    /// Computes a confidence that was not measured when the job ended, if it is now.
    fn measure(&mut self, calibration: &Calibration, candidates: &[Candidate]) {
        if self.confidence.is_none() {
            self.confidence =
                calibration.refined_confidence(candidates, &self.image_id, self.evidence);
            self.evidence = self.evidence.filter(|_| self.confidence.is_none());
        }
    }
}

impl Job {
    /// Whether a confidence in it is not measured yet.
    pub fn is_unmeasured(&self) -> bool {
        self.estimate.as_ref().is_some_and(|estimate| estimate.confidence.is_none())
            || self.verdicts.iter().any(|verdict| verdict.confidence.is_none())
    }

    /// Computes the confidences that were not measured when the job ended, as far as they are now. `candidates` are those
    /// of the job, and a place is known from the confidence `known_from`.
    pub fn measure(
        &mut self,
        calibration: &Calibration,
        candidates: &[Candidate],
        known_from: f64,
    ) {
        if let Some(estimate) = &mut self.estimate {
            estimate.measure(calibration, candidates, known_from);
        }
        self.verdicts.iter_mut().for_each(|verdict| verdict.measure(calibration, candidates));
    }

    /// The job without the results of refinement.
    pub fn summary(self) -> Self {
        Self { descriptions: Vec::new(), ranking: None, reasoning: None, texts: None, ..self }
    }

    /// Creates a queued job.
    pub fn queued(map: MapName, query_id: Uuid, refiner: RefinerKind, now: Timestamp) -> Self {
        Self {
            id: Uuid::now_v7(),
            map,
            query_id,
            refiner,
            priority: Priority::default(),
            state: JobState::Queued,
            created_at: now,
            started_at: None,
            finished_at: None,
            attempts: 0,
            descriptions: Vec::new(),
            ranking: None,
            reasoning: None,
            reasoning_took_ms: None,
            estimate: None,
            texts: None,
            verdicts: Vec::new(),
            fresh_since: None,
            usage: Usage::default(),
            error: None,
            trace_id: None,
        }
    }
}
