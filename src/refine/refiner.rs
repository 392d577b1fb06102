//! The refiner trait, and the optional abilities of refiners.

use std::time::Duration;

use async_trait::async_trait;
use whereabouts_core::{
    Agreement, CacheLevels, Certainty, Description, Evidence, ImageId, JobVerdict, Map,
    ModelServer, PairRegion, Ranking, RefinerKind, Spent, Usage,
};
use whereabouts_store::{HardNegatives, Step, StoreError};

use super::RefineInput;

/// Compares a frame with its candidates and ranks the candidates again.
#[async_trait]
pub trait Refiner: Send + Sync {
    /// Returns which refiner this is.
    fn kind(&self) -> RefinerKind;
    /// Refines one query and reports each step to `progress`. Dropping the future cancels the refinement.
    async fn refine(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError>;
    /// Whether [`RefineInput::frame`] should carry the frame's descriptor.
    fn wants_descriptor(&self) -> bool {
        false
    }
    /// Returns once the refiner could make use of another job, besides those that wait for a network
    /// ([`Progress::waiting`]).
    async fn room(&self) {}
    /// Returns the refiner's ability to show which regions a pair has in common, if it has it.
    fn region_matcher(&self) -> Option<&dyn RegionMatcher> {
        None
    }
    /// Returns the refiner's ability to measure hard negatives, if it has it.
    fn negative_evidence(&self) -> Option<&dyn NegativeEvidence> {
        None
    }
    /// Returns the refiner's ability to ask its paid model about hard negatives, if it has one.
    fn paid_negatives(&self) -> Option<&dyn PaidNegatives> {
        None
    }
    /// Returns the state of the refiner's calls to a paid model, if it makes any.
    fn paid_calls(&self) -> Option<&dyn PaidCalls> {
        None
    }
}

/// Shows which regions two pictures have in common.
#[async_trait]
pub trait RegionMatcher: Send + Sync {
    /// Returns the regions that the frame and one of its candidates have in common, the most distinctive
    /// first; `None` if the image is not among the candidates or no longer in the map.
    async fn regions(
        &self,
        input: &RefineInput,
        image: &ImageId,
    ) -> Result<Option<Vec<PairRegion>>, RefineError>;
    /// Returns how many regions the frame has in common with each of its candidates.
    async fn agreement(&self, input: &RefineInput) -> Result<Agreement, RefineError>;
}

/// Measures how strong the evidence for a wrong candidate gets. Calibration builds the null distributions
/// of a map from these measurements.
#[async_trait]
pub trait NegativeEvidence: Send + Sync {
    /// Returns the evidence for candidates that all show other places, of each kind that the refiner or a model that
    /// relies on it can have; empty if their query image is no longer in the map.
    async fn best_negative(
        &self,
        map: &Map,
        negatives: &HardNegatives,
    ) -> Result<Vec<Evidence>, RefineError>;
}

/// Asks a paid model about candidates that all show other places.
#[async_trait]
pub trait PaidNegatives: Send + Sync {
    /// Returns the most that a measurement with that many candidates costs, retries and repairs left out.
    fn cost(&self, candidates: usize) -> PaidMeasurement;
    /// Returns the evidence of the model's verdict; `None` if it gave none, or if the query image is no longer in the
    /// map.
    async fn verdict(
        &self,
        map: &Map,
        negatives: &HardNegatives,
    ) -> Result<Option<Evidence>, RefineError>;
}

/// The cost of one measurement with a paid model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaidMeasurement {
    /// Calls.
    pub calls: usize,
    /// Tokens sent and received, estimated.
    pub tokens: u64,
    /// Money at the configured prices; 0 without prices.
    pub money: f64,
}

/// Reports on a refiner's calls to a paid model.
pub trait PaidCalls: Send + Sync {
    /// Returns the current levels.
    fn levels(&self) -> PaidCallLevels;
    /// Returns what is known about the servers of the models.
    fn servers(&self) -> Vec<ModelServer>;
}

/// The state of a refiner's calls to a paid model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaidCallLevels {
    /// Whether calls are suspended because the last ones failed.
    pub suspended: bool,
    /// What is spent today (UTC), including reservations of calls in progress.
    pub spent_today: Spent,
    /// What may be spent a day; 0 stands for no limit.
    pub limit: Spent,
    /// Calls that are sent and not answered.
    pub calls_in_flight: usize,
    /// Calls that are made at once at most, which follows what the servers bear.
    pub calls_at_once: usize,
    /// The size of the description cache.
    pub cache: CacheLevels,
}

/// Receives the steps of a refinement as they are completed.
#[async_trait]
pub trait Progress: Send + Sync {
    /// Records a completed step. The refinement's final usage includes the step's cost.
    async fn step(&self, step: Step);
    /// Says whether the refinement waits for a network from now on, or needs this machine. While it waits, others
    /// may begin.
    fn waiting(&self, _waits: bool) {}
}

/// Watches a refinement whose steps are not kept, as that of a measurement.
pub(crate) struct Unwatched;

#[async_trait]
impl Progress for Unwatched {
    async fn step(&self, _: Step) {}
}

/// The result of a refinement.
#[derive(Debug, Clone, PartialEq)]
pub struct Refinement {
    /// One text for each candidate that could be compared, in coarse order.
    pub descriptions: Vec<Description>,
    /// How far the regions of the frame and each candidate agree, if that was measured.
    pub agreement: Option<Agreement>,
    /// What each refiner found, if there was more than one.
    pub verdicts: Vec<JobVerdict>,
    /// The candidates in refined order.
    pub ranking: Ranking,
    /// The refiner whose order it is, if that is not the one that was asked.
    pub ordered_by: Option<RefinerKind>,
    /// The evidence for the first of the ranking, if the refiner measures it.
    pub evidence: Option<Evidence>,
    /// How certain the model says it is of the first of the ranking, if a model says so.
    pub certainty: Option<Certainty>,
    /// Why the candidates are in this order.
    pub reasoning: Option<String>,
    /// Duration of the call that gave the order, in milliseconds, if there was one.
    pub reasoning_took_ms: Option<u64>,
    /// The cost of this attempt.
    pub usage: Usage,
    /// Why part of the ranking is in coarse order, if it is.
    pub degraded: Option<String>,
}

/// Why a refinement failed.
#[derive(Debug, thiserror::Error)]
pub enum RefineError {
    /// A retry would fail in the same way.
    #[error("{0}")]
    Permanent(String),
    /// A retry may succeed.
    #[error("{0}")]
    Transient(String),
    /// The refinement is fine but cannot be done now.
    #[error("{why}")]
    Deferred {
        /// What it waits for.
        why: String,
        /// When to try again.
        after: Duration,
    },
}

impl Refinement {
    /// Marks the refinement as that of a refiner that stood in for another.
    pub(crate) fn stands_in(self, by: RefinerKind, why: String) -> Self {
        let degraded = Some(match self.degraded {
            Some(also) => format!("{why}; {also}"),
            None => why,
        });
        Self { ordered_by: Some(by), degraded, ..self }
    }

    /// Returns why the place of the frame cannot be known, if the refinement says so.
    pub fn why_unknown(&self) -> Option<&'static str> {
        (self.evidence == Some(Evidence::NONE_OF_THESE))
            .then_some("the model says that none of the candidates shows the place")
    }
}

impl From<StoreError> for RefineError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::NotFound(_) | StoreError::Conflict(_) | StoreError::Damaged(_) => {
                Self::Permanent(error.to_string())
            }
            StoreError::QueueFull { .. }
            | StoreError::Full { .. }
            | StoreError::Unavailable(_)
            | StoreError::Failed(_)
            | StoreError::Superseded(_) => Self::Transient(error.to_string()),
        }
    }
}

/// Converts a duration to whole milliseconds, the unit of the API.
pub(crate) fn milliseconds(took: Duration) -> u64 {
    u64::try_from(took.as_millis()).unwrap_or(u64::MAX)
}
