//! The refiner `mllm`: a multimodal LLM describes each pair, and another call over all descriptions
//! orders the candidates.
//!
//! | file | what it does |
//! |---|---|
//! | `settings`, `secret` | what can be configured; a key that is never shown |
//! | `prompts` | what the models are asked |
//! | `describe`, `pictures`, `flight`, `cache` | one description for each pair, bought once |
//! | `rank`, `reason` | the reasoning call; from its answer to a permutation |
//! | `client`, `wire` | the chat-completions format over HTTP |
//! | `retry`, `breaker`, `rate`, `budget` | patience and limits |
//!
//! What a model says is untrusted: it can change the order of these candidates, and nothing else.

mod breaker;
mod budget;
mod cache;
mod client;
mod conclude;
mod describe;
mod flight;
mod pictures;
mod prompts;
mod rank;
mod rate;
mod reason;
mod retry;
mod secret;
mod settings;
mod wire;

#[cfg(test)]
#[path = "../../../tests/blackbox/mock_mllm.rs"]
mod mock_mllm;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use async_trait::async_trait;
use jiff::Timestamp;

pub use budget::Spent;
pub use cache::{CachedDescription, DescriptionCache};
pub use prompts::PROMPT_VERSION;
pub use secret::Secret;
pub use settings::{KeyHeader, MaxTokensField, MllmSettings, MllmSettingsError, OnUnavailable};

use self::budget::Budget;
use self::client::MllmClient;
use self::describe::{Work, sum};
use self::flight::Flights;
use self::pictures::Pictures;
use self::retry::CallError;
use super::{RefineError, Refinement, Refiner};
use crate::domain::{Map, RefinerKind};
use crate::retrieve::ImageLimits;
use crate::store::{BlobStore, JobRecord, MapStore};

/// What an [`MllmRefiner`] works with.
pub struct MllmParts {
    /// Where the candidates' records are.
    pub maps: Arc<dyn MapStore>,
    /// Where their bytes are.
    pub blobs: Arc<dyn BlobStore>,
    /// Descriptions that were paid for.
    pub cache: Arc<dyn DescriptionCache>,
    /// Bounds on the pictures that are decoded.
    pub limits: ImageLimits,
    /// Who takes a job while no call may be made, if `on_unavailable` is `local`.
    pub fallback: Option<Arc<dyn Refiner>>,
}

/// Comparing by a multimodal LLM.
///
/// K + 1 calls for a job of K candidates; a pair that was described before costs none.
pub struct MllmRefiner {
    maps: Arc<dyn MapStore>,
    cache: Arc<dyn DescriptionCache>,
    fallback: Option<Arc<dyn Refiner>>,
    pictures: Pictures,
    client: MllmClient,
    budget: Arc<Budget>,
    flights: Flights<CachedDescription>,
    settings: MllmSettings,
}

/// How an [`MllmRefiner`] stands, for metrics.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MllmLevels {
    /// Whether calls are suspended because the last ones failed.
    pub suspended: bool,
    /// What is spent today (UTC), calls in progress included.
    pub spent_today: Spent,
}

impl MllmRefiner {
    /// Puts a refiner together. Reads the key; calls nobody yet.
    pub fn new(parts: MllmParts, settings: MllmSettings) -> Result<Self, MllmSettingsError> {
        let client = MllmClient::new(&settings)?;
        let pictures = Pictures::new(parts.blobs, parts.limits, settings.image_max_edge)
            .map_err(|error| MllmSettingsError::Client(error.to_string()))?;
        Ok(Self {
            maps: parts.maps,
            cache: parts.cache,
            fallback: parts.fallback,
            pictures,
            client,
            budget: Arc::new(Budget::new(settings.limits())),
            flights: Flights::default(),
            settings,
        })
    }

    /// Says what was spent today (UTC) before this process began.
    pub fn seed_spent_today(&self, spent: Spent) {
        self.budget.seed(Timestamp::now(), spent);
    }

    /// How it stands.
    pub fn levels(&self) -> MllmLevels {
        MllmLevels {
            suspended: self.client.is_suspended(),
            spent_today: self.budget.spent(Timestamp::now()),
        }
    }

    fn waits(&self) -> bool {
        self.settings.on_unavailable == OnUnavailable::Wait
    }

    async fn map(&self, record: &JobRecord) -> Result<Map, RefineError> {
        match self.maps.map(&record.job.map).await? {
            Some(map) if map.uid == record.map_uid => Ok(map),
            _ => Err(RefineError::Hopeless("the map was removed".into())),
        }
    }

    /// Has another refiner do the job, and says so.
    async fn fall_back(
        &self,
        fallback: &dyn Refiner,
        work: &Work<'_>,
        why: &CallError,
    ) -> Result<Refinement, RefineError> {
        let refinement = fallback.refine(work.record).await?;
        let said = format!("refined by `{}` instead of `mllm`: {why}", fallback.kind());
        Ok(Refinement {
            usage: sum(work.usage(), refinement.usage),
            degraded: Some(match refinement.degraded {
                Some(also) => format!("{said}; {also}"),
                None => said,
            }),
            ..refinement
        })
    }
}

#[async_trait]
impl Refiner for MllmRefiner {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Mllm
    }

    async fn refine(&self, record: &JobRecord) -> Result<Refinement, RefineError> {
        let map = self.map(record).await?;
        let work = Work::new(record, map.scene, self.budget.for_job());
        let pairs = self.pairs(&map, record).await?;
        let findings = self.describe_all(&work, &pairs).await;
        let ranked = match (findings.described.as_slice(), conclude::gravest(&findings.failed)) {
            ([], None) => None,
            ([], Some(error)) => Some(Err(error)),
            (described, _) => Some(self.rank(&work, described).await),
        };
        match (ranked, &self.fallback) {
            (Some(Err(why)), Some(fallback)) if conclude::is_unavailable(&why) && !self.waits() => {
                self.fall_back(fallback.as_ref(), &work, &why).await
            }
            (Some(Err(why)), _) if findings.described.is_empty() => Err(conclude::given_up(&why)),
            (Some(Err(CallError::DaySpent)), _) if self.waits() => {
                Err(conclude::given_up(&CallError::DaySpent))
            }
            (ranked, _) => conclude::conclude(&work, findings, ranked),
        }
    }
}
