//! The refiner `mllm`: a multimodal LLM describes each pair, and another call ranks the candidates by these
//! descriptions.
//!
//! | file | what it does |
//! |---|---|
//! | `settings` | the section `[mllm]` of the configuration |
//! | `prompts` | the prompts |
//! | `run` | the state of one refinement |
//! | `describe`, `pictures` | one description for each pair |
//! | `buy_once`, `single_flight`, `lease` | a description is bought once: in this process, across processes |
//! | `rank`, `reason`, `conclude` | the reasoning call, and from its answer to a ranking |
//! | `client`, `endpoint`, `wire` | the chat-completions format over HTTP |
//! | `spend`, `budget`, `reservation` | limits on spend: in this process, across processes |
//! | `retry`, `breaker`, `rate` | retries, circuit breaker, rate limits |
//!
//! A model's answer is untrusted input: it can change the order of these candidates, and nothing else.

mod breaker;
mod budget;
mod buy_once;
mod client;
mod conclude;
mod describe;
mod endpoint;
mod lease;
mod pictures;
mod prompts;
mod rank;
mod rate;
mod reason;
mod reservation;
mod retry;
mod run;
mod settings;
mod single_flight;
mod spend;
mod wire;

#[cfg(test)]
pub(crate) mod tests;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use whereabouts_core::{DayUsage, RefinerKind, Spent, utc_day};
use whereabouts_store::{
    BlobStore, DescriptionCache, MapStore, SharedLimits, TokenBuckets, UsageStore,
};
use whereabouts_vision::ImageLimits;

pub use prompts::PROMPT_VERSION;
pub use reason::{AnswerError, Labels, Verdict};
pub use retry::{random_fraction, retry_after};
pub use settings::{KeyHeader, MaxTokensField, MllmSettings, MllmSettingsError, OnUnavailable};

use self::buy_once::BuyOnce;
use self::client::MllmClient;
use self::pictures::Pictures;
use self::retry::CallError;
use self::run::RefineRun;
use self::spend::SpendControl;
use crate::{
    BuildError, NegativeEvidence, PaidCallLevels, PaidCalls, Progress, RefineError, RefineInput,
    RefineMetrics, Refinement, Refiner, RefinerContext, RefinerSettings, local,
};

/// The parts that an [`MllmRefiner`] is built from.
pub struct MllmParts {
    /// The records of the candidates.
    pub maps: Arc<dyn MapStore>,
    /// The pictures.
    pub blobs: Arc<dyn BlobStore>,
    /// Descriptions that were paid for.
    pub cache: Arc<dyn DescriptionCache>,
    /// Accounts of what was paid.
    pub usage: Arc<dyn UsageStore>,
    /// Limits that several processes share, if there are several.
    pub shared: Option<Arc<dyn SharedLimits>>,
    /// Counts lookups of descriptions.
    pub metrics: Arc<RefineMetrics>,
    /// Bounds on the pictures that are decoded.
    pub limits: ImageLimits,
    /// Refines while no call may be made, if `mllm.on_unavailable` is `local`.
    pub fallback: Option<Arc<dyn Refiner>>,
}

/// Compares pictures with a multimodal LLM.
///
/// A job of K candidates takes K + 1 calls, less those whose pair is in the description cache.
pub struct MllmRefiner {
    maps: Arc<dyn MapStore>,
    cache: Arc<dyn DescriptionCache>,
    usage: Arc<dyn UsageStore>,
    fallback: Option<Arc<dyn Refiner>>,
    pictures: Pictures,
    client: MllmClient,
    descriptions: BuyOnce,
    spend: SpendControl,
    settings: MllmSettings,
}

/// Builds the refiner `mllm`, with `local` as its fallback.
pub(crate) async fn build(context: &RefinerContext) -> Result<Arc<dyn Refiner>, BuildError> {
    let store = &context.store;
    let parts = MllmParts {
        maps: store.clone(),
        blobs: store.clone(),
        cache: store.clone(),
        usage: store.clone(),
        shared: context.shared.clone(),
        metrics: Arc::clone(&context.metrics),
        limits: context.models.limits(),
        fallback: Some(local::build(context).await?),
    };
    let refiner = MllmRefiner::new(parts, context.settings.mllm.clone())?;
    // Read before the workers start, and so before this process spends anything.
    refiner.seed_spent_today(&store.usage(utc_day(Timestamp::now())).await?);
    Ok(Arc::new(refiner))
}

/// Returns a text that changes with everything that decides what the refiner finds.
pub(crate) fn fingerprint(settings: &RefinerSettings) -> Result<String, BuildError> {
    let mllm = serde_json::to_string(&settings.mllm)?;
    Ok(format!("{PROMPT_VERSION} {mllm} {}", local::fingerprint(settings)?))
}

impl MllmRefiner {
    /// Builds a refiner. Reads the API key from its file, but makes no call.
    pub fn new(parts: MllmParts, settings: MllmSettings) -> Result<Self, MllmSettingsError> {
        let client = MllmClient::new(&settings, TokenBuckets::new(parts.shared.clone()))?;
        let pictures = Pictures::new(parts.blobs, parts.limits, settings.image_max_edge)
            .map_err(|error| MllmSettingsError::Client(error.to_string()))?;
        Ok(Self {
            maps: parts.maps,
            descriptions: BuyOnce::new(Arc::clone(&parts.cache), parts.metrics),
            cache: parts.cache,
            usage: parts.usage,
            fallback: parts.fallback,
            pictures,
            client,
            spend: SpendControl::new(settings.limits(), parts.shared),
            settings,
        })
    }

    /// Sets what was spent today (UTC) before this process started.
    pub fn seed_spent_today(&self, spent: &[DayUsage]) {
        let now = Timestamp::now();
        let today = utc_day(now);
        let spent = spent.iter().filter(|spent| spent.date == today);
        self.spend.budget.seed(now, spent.map(Spent::from).fold(Spent::default(), Spent::plus));
    }

    /// Has the fallback refine the job, and reports that in `degraded`.
    async fn fall_back(
        &self,
        fallback: &dyn Refiner,
        run: &RefineRun<'_>,
        why: &CallError,
    ) -> Result<Refinement, RefineError> {
        let refinement = fallback.refine(run.input, run.progress).await?;
        let degraded = format!("refined by `{}` instead of `mllm`: {why}", fallback.kind());
        Ok(Refinement {
            usage: run.usage() + refinement.usage,
            degraded: Some(match refinement.degraded {
                Some(also) => format!("{degraded}; {also}"),
                None => degraded,
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

    /// Jobs that fall back are calibrated as the fallback's are.
    fn negative_evidence(&self) -> Option<&dyn NegativeEvidence> {
        self.fallback.as_ref()?.negative_evidence()
    }

    fn paid_calls(&self) -> Option<&dyn PaidCalls> {
        Some(self)
    }

    async fn refine(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let budget =
            self.spend.budget.for_job(input.spent.prompt_tokens, input.spent.completion_tokens);
        let similar = self.similar_frames(input).await?;
        let run = RefineRun::new(input, budget, similar, progress);
        let pairs = self.pairs(input).await?;
        let pairs = self.describe_all(&run, &pairs).await;
        let ranked = match (pairs.described.as_slice(), conclude::most_serious(&pairs.failed)) {
            ([], None) => None,
            ([], Some(error)) => Some(Err(error)),
            (described, _) => Some(self.rank(&run, described).await),
        };
        let waits = self.settings.on_unavailable == OnUnavailable::Wait;
        match (ranked, &self.fallback) {
            (Some(Err(why)), _) if waits && let Some(after) = available_after(&why) => {
                Err(RefineError::Deferred { why: why.to_string(), after })
            }
            (Some(Err(why)), Some(fallback)) if conclude::is_unavailable(&why) => {
                self.fall_back(fallback.as_ref(), &run, &why).await
            }
            (Some(Err(why)), _) if pairs.described.is_empty() => Err(conclude::failure(&why)),
            (ranked, _) => conclude::conclude(&run, pairs, ranked),
        }
    }
}

impl PaidCalls for MllmRefiner {
    fn levels(&self) -> PaidCallLevels {
        PaidCallLevels {
            suspended: self.client.is_suspended(),
            spent_today: self.spend.budget.spent(Timestamp::now()),
            limit: self.spend.daily_limit(),
            cache: self.cache.levels(),
        }
    }
}

/// Returns how long it is until calls may be made again, where that is known.
fn available_after(why: &CallError) -> Option<Duration> {
    match why {
        // At least a little, because the breaker may be about to close.
        CallError::Suspended { wait } => Some((*wait).max(Duration::from_millis(100))),
        CallError::DaySpent => {
            let now = Timestamp::now();
            let midnight = utc_day(now).tomorrow().ok()?.to_zoned(TimeZone::UTC).ok()?;
            now.duration_until(midnight.timestamp()).try_into().ok()
        }
        CallError::Permanent(_) | CallError::Transient(_) | CallError::JobSpent => None,
    }
}
