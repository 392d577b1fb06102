//! The refiner `mllm`: a multimodal LLM describes each pair, and another call ranks the candidates by these
//! descriptions.
//!
//! | file | what it does |
//! |---|---|
//! | `settings` | the section `[mllm]` of the configuration |
//! | `prompts` | the prompts |
//! | `run` | the state of one refinement |
//! | `describe`, `judge`, `pictures`, `kept`, `side_by_side` | one description for each pair, and what is none |
//! | `buy_once`, `single_flight`, `lease` | a description is bought once: in this process, across processes |
//! | `rank`, `labels`, `conclude` | the reasoning call, and from its answer to a ranking |
//! | `answer`, `order`, `loose_json`, `schema` | what the reasoning model is asked to write, and what it writes |
//! | `client`, `attempt`, `forms`, `exchange`, `endpoint` | calls to a server over HTTP |
//! | `wire`, `response`, `error_body`, `thinking`, `tokens` | the chat-completions format, in all its dialects |
//! | `capability`, `check`, `check_calls`, `server_facts` | what a server can do, found out by trying |
//! | `negatives` | the model's verdicts on images of other places, for calibration |
//! | `spend`, `budget`, `reservation` | limits on spend: in this process, across processes |
//! | `failure`, `retry`, `breaker`, `rate` | kinds of failures, retries, circuit breaker, rate limits |
//! | `gate`, `limit` | which call is next, and how many at once a server bears |
//!
//! A model's answer is untrusted input: it can change the order of these candidates, and nothing else.

mod answer;
mod attempt;
mod breaker;
mod budget;
mod buy_once;
mod capability;
mod check;
mod check_calls;
mod client;
mod conclude;
mod describe;
mod endpoint;
mod error_body;
mod exchange;
mod failure;
mod forms;
mod gate;
mod judge;
mod kept;
mod labels;
mod lease;
mod limit;
mod loose_json;
mod negatives;
mod order;
mod pictures;
mod prompts;
mod rank;
mod rate;
mod reservation;
mod response;
mod retry;
mod run;
mod schema;
mod server_facts;
mod settings;
mod side_by_side;
mod single_flight;
mod spend;
mod thinking;
mod tokens;
mod wire;

#[cfg(test)]
pub(crate) mod tests;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use whereabouts_core::{
    Agreement, Calibration, DayUsage, ModelServer, RefinerKind, Spent, utc_day,
};
use whereabouts_store::{
    BlobStore, DescriptionCache, MapStore, SharedLimits, TokenBuckets, UsageStore,
};
use whereabouts_vision::ImageLimits;

pub use answer::AnswerError;
pub use check::{CheckedServer, Finding, check};
pub use labels::{Labels, Verdict};
pub use prompts::PROMPT_VERSION;
pub use response::is_readable;
pub use retry::{random_fraction, retry_after};
pub use settings::{
    KeyHeader, MaxTokensField, MllmSettings, MllmSettingsError, OnUnavailable, ServerSettings,
};

use self::buy_once::BuyOnce;
use self::client::MllmClient;
use self::conclude::Order;
use self::describe::{DescribedPair, DescribedPairs};
use self::limit::CallPurpose;
use self::pictures::Pictures;
use self::retry::CallError;
use self::run::RefineRun;
use self::spend::SpendControl;
use crate::{
    BuildError, NegativeEvidence, PaidCallLevels, PaidCalls, PaidNegatives, Progress, RefineError,
    RefineInput, RefineMetrics, Refinement, Refiner, RefinerContext, RefinerSettings, local,
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
    /// The server of the describing model.
    describer: Arc<MllmClient>,
    /// The server of the reasoning model; often the same.
    reasoner: Arc<MllmClient>,
    descriptions: BuyOnce,
    spend: SpendControl,
    settings: MllmSettings,
}

/// Builds the refiner `mllm`, with `local` as its fallback.
pub(crate) async fn build(context: &RefinerContext) -> Result<Arc<dyn Refiner>, BuildError> {
    Ok(shared(context).await?)
}

/// Returns the one instance of a process, so that all refiners that ask the model share its budgets, rates and circuit
/// breaker.
pub(crate) async fn shared(context: &RefinerContext) -> Result<Arc<MllmRefiner>, BuildError> {
    context.model.get_or_try_init(|| build_model(context)).await.cloned()
}

async fn build_model(context: &RefinerContext) -> Result<Arc<MllmRefiner>, BuildError> {
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
    if context.settings.mllm.check_at_start {
        refiner.check_in_background();
    }
    Ok(Arc::new(refiner))
}

/// Returns a text that changes with everything that decides what the refiner finds.
pub(crate) fn fingerprint(settings: &RefinerSettings) -> Result<String, BuildError> {
    let mllm = serde_json::to_string(&settings.mllm)?;
    let evidence = Calibration::EVIDENCE;
    Ok(format!("{PROMPT_VERSION} {evidence} {mllm} {}", local::fingerprint(settings)?))
}

impl MllmRefiner {
    /// Builds a refiner. Reads the API key from its file, but makes no call.
    pub fn new(parts: MllmParts, settings: MllmSettings) -> Result<Self, MllmSettingsError> {
        let client = |server: &ServerSettings| {
            let buckets = TokenBuckets::new(parts.shared.clone());
            MllmClient::new(&settings, server, buckets).map(Arc::new)
        };
        let describer = client(&settings.describing())?;
        let reasoner = match settings.has_two_servers() {
            true => client(&settings.reasoning())?,
            false => Arc::clone(&describer),
        };
        let pictures = Pictures::new(
            parts.blobs,
            parts.limits,
            settings.image_max_edge,
            settings.pictures_bytes,
        )
        .map_err(|error| MllmSettingsError::Client(error.to_string()))?;
        Ok(Self {
            maps: parts.maps,
            descriptions: BuyOnce::new(Arc::clone(&parts.cache), parts.metrics),
            cache: parts.cache,
            usage: parts.usage,
            fallback: parts.fallback,
            pictures,
            describer,
            reasoner,
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

    /// Finds out what the servers can do. Calls wait until that is known.
    pub fn check_in_background(&self) {
        check::in_background(&self.describer, &self.reasoner, &self.settings);
    }

    /// Has the fallback refine a job without any description, and reports that in `degraded`.
    async fn fall_back(
        &self,
        fallback: &dyn Refiner,
        run: &RefineRun<'_>,
        why: &CallError,
    ) -> Result<Refinement, RefineError> {
        run.progress.waiting(false);
        let refinement = fallback.refine(run.input, run.progress).await?;
        let why = format!("refined by `{}` instead of `mllm`: {why}", fallback.kind());
        let usage = run.usage() + refinement.usage;
        Ok(Refinement { usage, ..refinement.stands_in(fallback.kind(), why) })
    }

    /// Refines a job of which no pair was described.
    async fn without_descriptions(
        &self,
        fallback: Option<&dyn Refiner>,
        run: &RefineRun<'_>,
        why: &CallError,
    ) -> Result<Refinement, RefineError> {
        self.deferred(why)?;
        match fallback {
            Some(fallback) => self.fall_back(fallback, run, why).await,
            None => Err(conclude::failure(why)),
        }
    }

    /// Returns the order of the described candidates, from the model if it gives one.
    async fn order(
        &self,
        fallback: Option<&dyn Refiner>,
        run: &RefineRun<'_>,
        described: &[DescribedPair],
    ) -> Result<Order, RefineError> {
        let wanted = self.reasoner.gate().want(1);
        let ranked = self.rank(run, described).await;
        drop(wanted);
        let why = match ranked {
            Ok(ranking) => {
                self.reasoner.answers_are(CallPurpose::Rank, None);
                return Ok(Order::Model(ranking));
            }
            Err(why @ CallError::NoAnswer(_)) => {
                self.reasoner.answers_are(CallPurpose::Rank, Some(&why.to_string()));
                return Ok(Order::Coarse(why));
            }
            Err(why) => why,
        };
        tracing::warn!(job = %run.input.id, error = %why, "the reasoning call failed");
        self.deferred(&why)?;
        if run.input.attempts_left > 0 && matches!(why, CallError::Transient(_)) {
            return Err(RefineError::Transient(format!(
                "the reasoning call failed ({why}); it is tried again, and the descriptions are kept"
            )));
        }
        let Some(fallback) = fallback else { return Ok(Order::Coarse(why)) };
        run.progress.waiting(false);
        match fallback.refine(run.input, run.progress).await {
            Ok(refinement) => {
                Ok(Order::Fallback { refinement: Box::new(refinement), by: fallback.kind(), why })
            }
            Err(error) => {
                tracing::warn!(job = %run.input.id, %error, "the fallback failed, too");
                Ok(Order::Coarse(why))
            }
        }
    }

    /// Notes if the model described no pair although it answered: it refuses, or cannot see.
    fn judge_describer(&self, pairs: &DescribedPairs) {
        if pairs.described.iter().any(DescribedPair::is_bought) {
            self.describer.answers_are(CallPurpose::Describe, None);
        } else if pairs.described.is_empty()
            && let Some(CallError::NoAnswer(why)) = conclude::most_serious(&pairs.failed)
        {
            self.describer.answers_are(CallPurpose::Describe, Some(&why));
        }
    }

    /// Refines like [`Refiner::refine`], but does without the fallback: what the model cannot do is an error, or the
    /// coarse order.
    pub(crate) async fn refine_without_fallback(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        self.refine_with(None, input, progress).await
    }

    async fn refine_with(
        &self,
        fallback: Option<&dyn Refiner>,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        if self.settings.check_at_start {
            check::again(&self.describer, &self.reasoner, &self.settings);
        }
        let budget =
            self.spend.budget.for_job(input.spent.prompt_tokens, input.spent.completion_tokens);
        let similar = self.similar_frames(input).await?;
        let run = RefineRun::new(input, budget, similar, progress);
        let pairs = self.pairs(input).await?;
        let pairs = self.describe_all(&run, &pairs).await;
        self.judge_describer(&pairs);
        let described = match (pairs.described.as_slice(), conclude::most_serious(&pairs.failed)) {
            ([], None) => return conclude::conclude(&run, &pairs, Order::Nothing, None),
            ([], Some(why)) => return self.without_descriptions(fallback, &run, &why).await,
            (described, _) => described,
        };
        // This machine has nothing to do for the job while the model ranks.
        let agreement = async { Ok(self.agreement(fallback, input).await) };
        let (order, agreement) =
            futures_util::try_join!(self.order(fallback, &run, described), agreement)?;
        let agreement = agreement.filter(|_| matches!(order, Order::Model(_)));
        conclude::conclude(&run, &pairs, order, agreement.as_ref())
    }

    /// Returns how far the regions of the frame and its candidates agree; `None` if that cannot be found out.
    async fn agreement(
        &self,
        fallback: Option<&dyn Refiner>,
        input: &RefineInput,
    ) -> Option<Agreement> {
        let matcher = fallback?.region_matcher()?;
        matcher
            .agreement(input)
            .await
            .inspect_err(
                |error| tracing::warn!(job = %input.id, %error, "a verdict could not be checked"),
            )
            .ok()
    }

    /// Returns an error that defers the job, if the settings say so and it is known for how long.
    fn deferred(&self, why: &CallError) -> Result<(), RefineError> {
        match available_after(why) {
            Some(after) if self.settings.on_unavailable == OnUnavailable::Wait => {
                Err(RefineError::Deferred { why: why.to_string(), after })
            }
            _ => Ok(()),
        }
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

    fn paid_negatives(&self) -> Option<&dyn PaidNegatives> {
        Some(self)
    }

    fn paid_calls(&self) -> Option<&dyn PaidCalls> {
        Some(self)
    }

    async fn room(&self) {
        loop {
            self.reasoner.gate().room().await;
            self.describer.gate().room().await;
            if self.reasoner.gate().has_room() {
                return;
            }
        }
    }

    async fn refine(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        self.refine_with(self.fallback.as_deref(), input, progress).await
    }
}

impl PaidCalls for MllmRefiner {
    fn levels(&self) -> PaidCallLevels {
        let mut gates = vec![self.describer.gate().levels()];
        if self.settings.has_two_servers() {
            gates.push(self.reasoner.gate().levels());
        }
        PaidCallLevels {
            calls_in_flight: gates.iter().map(|gate| gate.sent).sum(),
            calls_at_once: gates.iter().map(|gate| gate.limit).sum(),
            suspended: self.describer.is_suspended() || self.reasoner.is_suspended(),
            spent_today: self.spend.budget.spent(Timestamp::now()),
            limit: self.spend.daily_limit(),
            cache: self.cache.levels(),
        }
    }

    fn servers(&self) -> Vec<ModelServer> {
        let mut servers = vec![self.describer.report()];
        if self.settings.has_two_servers() {
            servers.push(self.reasoner.report());
        }
        servers
    }
}

/// Returns how long it is until calls may be made again, where that is known.
fn available_after(why: &CallError) -> Option<Duration> {
    match why {
        // At least a little, because the breaker may be about to close.
        CallError::Suspended { wait, .. } | CallError::Stopped { wait, .. } => {
            Some((*wait).max(Duration::from_millis(100)))
        }
        CallError::DaySpent => {
            let now = Timestamp::now();
            let midnight = utc_day(now).tomorrow().ok()?.to_zoned(TimeZone::UTC).ok()?;
            now.duration_until(midnight.timestamp()).try_into().ok()
        }
        CallError::Permanent(_)
        | CallError::NoAnswer(_)
        | CallError::Transient(_)
        | CallError::JobSpent => None,
    }
}
