//! Jobs: one refinement of the candidates of one query.

use std::fmt;
use std::ops::{Add, AddAssign};
use std::str::FromStr;

use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use super::confidence::Estimate;
use super::map::display_as_written;
use super::{ImageId, InvalidName, MapName, Ranking};

/// Who compares a query with its candidates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RefinerKind {
    /// Geometric matching of dense features, on this machine.
    #[default]
    Local,
    /// A multimodal LLM.
    Mllm,
}

/// How far a job has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waits for a worker.
    Queued,
    /// A worker holds it.
    Running,
    /// Ended with a ranking.
    Succeeded,
    /// Ended with a ranking of which part fell back to the coarse order; `error` says why.
    Degraded,
    /// Ended without a ranking; `error` says why.
    Failed,
    /// Ended because a caller asked for it.
    Cancelled,
}

/// Which jobs are refined first: those of higher priority, and among equals the oldest.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Priority {
    /// When nothing else waits.
    Low,
    /// In its turn.
    #[default]
    Normal,
    /// Before all others.
    High,
}

display_as_written!(Priority { Low => "low", Normal => "normal", High => "high" });
display_as_written!(RefinerKind { Local => "local", Mllm => "mllm" });
display_as_written!(JobState {
    Queued => "queued",
    Running => "running",
    Succeeded => "succeeded",
    Degraded => "degraded",
    Failed => "failed",
    Cancelled => "cancelled"
});

impl JobState {
    /// Whether the job has ended for good.
    pub fn is_final(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }
}

/// The text that compares the query with one candidate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Description {
    /// The candidate.
    pub image_id: ImageId,
    /// What agrees and what differs, in words.
    pub text: String,
    /// Whether the text was known from an earlier job.
    pub cached: bool,
    /// The earlier frame that the text is about, where it stands in for this one because the two
    /// are nearly the same.
    #[serde(default)]
    #[schema(nullable)]
    pub stands_in: Option<StandIn>,
    /// Milliseconds that the model took to write it: of `mllm`, from the request that was answered to
    /// the end of its answer, without waiting for a turn and without earlier tries; of `local`, which
    /// compares all pairs together, an equal share of that. Null for a text that was known.
    #[serde(default)]
    pub took_ms: Option<u64>,
    /// What it cost.
    pub usage: Usage,
}

/// An earlier frame that is nearly the same.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StandIn {
    /// Its query.
    pub query_id: Uuid,
    /// Cosine similarity of the two frames' descriptors, −1 to 1.
    pub similarity: f32,
}

/// What a refinement cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct Usage {
    /// Calls to a model outside.
    pub calls: u32,
    /// Descriptions that were known from an earlier job.
    pub cached: u32,
    /// Tokens sent.
    pub prompt_tokens: u64,
    /// Tokens received.
    pub completion_tokens: u64,
    /// Of the calls, those whose tokens are a guess because the model's server did not count them.
    #[serde(default)]
    pub estimated: u32,
}

impl Add for Usage {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            calls: self.calls + other.calls,
            cached: self.cached + other.cached,
            prompt_tokens: self.prompt_tokens + other.prompt_tokens,
            completion_tokens: self.completion_tokens + other.completion_tokens,
            estimated: self.estimated + other.estimated,
        }
    }
}

impl AddAssign for Usage {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// The day that a moment falls on, in UTC: the days of budgets and accounts.
pub fn utc_day(at: Timestamp) -> Date {
    at.to_zoned(TimeZone::UTC).date()
}

/// What refining in one map cost on one day.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DayUsage {
    /// The day, in UTC.
    pub date: Date,
    /// The map.
    pub map: MapName,
    /// The calls and their tokens.
    pub usage: Usage,
    /// Money, in the currency of the configured prices, at the prices of the time.
    pub money: f64,
}

/// One refinement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Job {
    /// Its id; ids of later jobs sort after those of earlier ones.
    pub id: Uuid,
    /// The map of the query.
    pub map: MapName,
    /// The query.
    pub query_id: Uuid,
    /// Who refines.
    pub refiner: RefinerKind,
    /// Its place among the jobs that wait.
    #[serde(default)]
    pub priority: Priority,
    /// How far it has come.
    pub state: JobState,
    /// When it was queued.
    pub created_at: Timestamp,
    /// When a worker first took it.
    pub started_at: Option<Timestamp>,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
    /// How often a worker has taken it.
    pub attempts: u32,
    /// One text for each candidate compared so far, in coarse order.
    pub descriptions: Vec<Description>,
    /// The refined order, once there is one.
    #[schema(nullable)]
    pub ranking: Option<Ranking>,
    /// Why the ranking is as it is.
    pub reasoning: Option<String>,
    /// Milliseconds that the call took which ordered the candidates, counted as those of a description.
    /// Null if there was no such call; `local` makes none.
    #[serde(default)]
    pub reasoning_took_ms: Option<u64>,
    /// Where the frame was probably taken, by the refined order, once there is one.
    #[serde(default)]
    #[schema(nullable)]
    pub estimate: Option<Estimate>,
    /// What it cost so far, in all attempts since it was queued or last retried.
    pub usage: Usage,
    /// What went wrong, or what a job that is queued again waits for.
    pub error: Option<String>,
    /// The trace of its request and its refinement (W3C Trace Context), where the server sends traces.
    #[serde(default)]
    #[schema(nullable)]
    pub trace_id: Option<String>,
}

impl Job {
    /// The same without what refinement found out.
    pub fn summary(self) -> Self {
        Self { descriptions: Vec::new(), ranking: None, reasoning: None, ..self }
    }

    /// A new job, queued.
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
            usage: Usage::default(),
            error: None,
            trace_id: None,
        }
    }
}
