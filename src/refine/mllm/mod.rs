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

mod aside;
mod breaker;
mod budget;
mod client;
mod conclude;
mod describe;
mod flight;
mod pictures;
mod prompts;
mod purchase;
mod rank;
mod rate;
mod reason;
mod retry;
mod settings;
mod wire;

#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use jiff::Timestamp;
use jiff::tz::TimeZone;

pub use prompts::PROMPT_VERSION;
pub use reason::{AnswerError, Labels, Verdict};
pub use retry::{random_fraction, retry_after};
pub use settings::{KeyHeader, MaxTokensField, MllmSettings, MllmSettingsError, OnUnavailable};

use self::budget::Budget;
use self::client::MllmClient;
use self::describe::{Found, Work};
use self::flight::SingleFlight;
use self::pictures::Pictures;
use self::retry::CallError;
use super::{Progress, RefineError, Refinement, Refiner};
use crate::RefineMetrics;
use whereabouts_core::{CacheLevels, DayUsage, Evidence, Map, RefinerKind, Spent, Usage, utc_day};
use whereabouts_store::{
    BlobStore, DescriptionCache, HardNegatives, JobRecord, MapStore, SharedLimits, TokenBuckets,
    UsageStore,
};
use whereabouts_vision::ImageLimits;

/// What an [`MllmRefiner`] works with.
pub struct MllmParts {
    /// Where the candidates' records are.
    pub maps: Arc<dyn MapStore>,
    /// Where their bytes are.
    pub blobs: Arc<dyn BlobStore>,
    /// Descriptions that were paid for.
    pub cache: Arc<dyn DescriptionCache>,
    /// What was paid.
    pub usage: Arc<dyn UsageStore>,
    /// The limits of all processes, where there are several.
    pub shared: Option<Arc<dyn SharedLimits>>,
    /// What is counted.
    pub metrics: Arc<RefineMetrics>,
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
    usage: Arc<dyn UsageStore>,
    shared: Option<Arc<dyn SharedLimits>>,
    metrics: Arc<RefineMetrics>,
    fallback: Option<Arc<dyn Refiner>>,
    pictures: Pictures,
    client: MllmClient,
    budget: Arc<Budget>,
    flights: SingleFlight<Found>,
    settings: MllmSettings,
}

/// How an [`MllmRefiner`] stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MllmLevels {
    /// Whether calls are suspended because the last ones failed.
    pub suspended: bool,
    /// What is spent today (UTC), calls in progress included.
    pub spent_today: Spent,
    /// What may be spent a day; 0 stands for no limit.
    pub limit: Spent,
    /// How full the cache of descriptions is.
    pub cache: CacheLevels,
}

impl MllmRefiner {
    /// Puts a refiner together. Reads the key; calls nobody yet.
    pub fn new(parts: MllmParts, settings: MllmSettings) -> Result<Self, MllmSettingsError> {
        let client = MllmClient::new(&settings, TokenBuckets::new(parts.shared.clone()))?;
        let pictures = Pictures::new(parts.blobs, parts.limits, settings.image_max_edge)
            .map_err(|error| MllmSettingsError::Client(error.to_string()))?;
        Ok(Self {
            maps: parts.maps,
            cache: parts.cache,
            usage: parts.usage,
            shared: parts.shared,
            metrics: parts.metrics,
            fallback: parts.fallback,
            pictures,
            client,
            budget: Arc::new(Budget::new(settings.limits())),
            flights: SingleFlight::default(),
            settings,
        })
    }

    /// Says what was spent today (UTC) before this process began.
    pub fn seed_spent_today(&self, spent: &[DayUsage]) {
        let now = Timestamp::now();
        let today = utc_day(now);
        let spent = spent.iter().filter(|spent| spent.date == today);
        self.budget.seed(now, spent.map(Spent::from).fold(Spent::default(), Spent::plus));
    }

    /// What a job spends at this moment.
    fn spent_now(&self, record: &JobRecord, usage: Usage) -> DayUsage {
        let money = self.budget.cost(usage.prompt_tokens, usage.completion_tokens).money;
        let date = utc_day(Timestamp::now());
        DayUsage { date, map: record.job.map.clone(), usage, money }
    }

    fn waits(&self) -> bool {
        self.settings.on_unavailable == OnUnavailable::Wait
    }

    async fn map(&self, record: &JobRecord) -> Result<Map, RefineError> {
        match self.maps.map(&record.job.map).await? {
            Some(map) if map.uid == record.map_uid => Ok(map),
            _ => Err(RefineError::Permanent("the map was removed".into())),
        }
    }

    /// Has another refiner do the job, and says so.
    async fn fall_back(
        &self,
        fallback: &dyn Refiner,
        work: &Work<'_>,
        why: &CallError,
    ) -> Result<Refinement, RefineError> {
        let refinement = fallback.refine(work.record, work.progress).await?;
        let said = format!("refined by `{}` instead of `mllm`: {why}", fallback.kind());
        Ok(Refinement {
            usage: work.usage() + refinement.usage,
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

    fn wants_descriptor(&self) -> bool {
        self.settings.similar_frame_min > 0.0
    }

    fn levels(&self) -> Option<MllmLevels> {
        Some(MllmLevels {
            suspended: self.client.is_suspended(),
            spent_today: self.budget.spent(Timestamp::now()),
            limit: Spent {
                tokens: self.settings.tokens_per_day,
                money: self.settings.money_per_day,
            },
            cache: self.cache.levels(),
        })
    }

    /// Of the jobs that fall back.
    async fn chance(
        &self,
        map: &Map,
        asked: &HardNegatives,
    ) -> Result<Option<Evidence>, RefineError> {
        match &self.fallback {
            Some(fallback) => fallback.chance(map, asked).await,
            None => Ok(None),
        }
    }

    async fn refine(
        &self,
        record: &JobRecord,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let map = self.map(record).await?;
        // What earlier attempts spent is spent.
        let spent = record.job.usage;
        let budget = self.budget.for_job(spent.prompt_tokens, spent.completion_tokens);
        let mut work = Work::new(record, &map, budget, progress);
        work.similar = self.similar_frames(&work).await?;
        let pairs = self.pairs(&map, record).await?;
        let findings = self.describe_all(&work, &pairs).await;
        let ranked = match (findings.described.as_slice(), conclude::gravest(&findings.failed)) {
            ([], None) => None,
            ([], Some(error)) => Some(Err(error)),
            (described, _) => Some(self.rank(&work, described).await),
        };
        match (ranked, &self.fallback) {
            (Some(Err(why)), _)
                if self.waits()
                    && let Some(after) = pause(&why) =>
            {
                Err(RefineError::Deferred { why: why.to_string(), after })
            }
            (Some(Err(why)), Some(fallback)) if conclude::is_unavailable(&why) => {
                self.fall_back(fallback.as_ref(), &work, &why).await
            }
            (Some(Err(why)), _) if findings.described.is_empty() => Err(conclude::given_up(&why)),
            (ranked, _) => conclude::conclude(&work, findings, ranked),
        }
    }
}

/// How long it is until calls may be made again, where that is known.
fn pause(why: &CallError) -> Option<Duration> {
    match why {
        // At least a little: the breaker may have opened for no time at all.
        CallError::Suspended { wait } => Some((*wait).max(Duration::from_millis(100))),
        CallError::DaySpent => {
            let now = Timestamp::now();
            let midnight = utc_day(now).tomorrow().ok()?.to_zoned(TimeZone::UTC).ok()?;
            now.duration_until(midnight.timestamp()).try_into().ok()
        }
        CallError::Permanent(_) | CallError::Transient(_) | CallError::JobSpent => None,
    }
}
