//! The refiner `cascade`: `local` first, and the model of `mllm` only where the answer of `local` is in question, about
//! the candidates that are still in question only.
//!
//! `question` decides; this file asks, and merges the two verdicts. Calls, budgets and descriptions are those of
//! `mllm`: the same instance makes them.

mod question;

#[cfg(test)]
mod tests;

use std::sync::Arc;

use async_trait::async_trait;
use parking_lot::Mutex;
use whereabouts_core::{
    Agreement, Calibration, Description, Evidence, ImageId, JobVerdict, Map, Ranking, RefinerKind,
    SamePlace, Usage,
};
use whereabouts_store::{HardNegatives, MapStore, Step};

pub use question::CascadeSettings;

use self::question::{LocalFinding, Question, question};
use crate::mllm::MllmRefiner;
use crate::{
    BuildError, NegativeEvidence, PaidCalls, PaidMeasurement, PaidNegatives, Progress, RefineError,
    RefineInput, Refinement, Refiner, RefinerContext, RefinerSettings, RegionMatcher, Unwatched,
    local, mllm,
};

/// `local` first, then the model where it is needed.
pub struct CascadeRefiner {
    /// Calibrations.
    maps: Arc<dyn MapStore>,
    local: Arc<dyn Refiner>,
    model: Arc<MllmRefiner>,
    settings: CascadeSettings,
}

/// Builds the refiner `cascade`.
pub(crate) async fn build(context: &RefinerContext) -> Result<Arc<dyn Refiner>, BuildError> {
    Ok(Arc::new(CascadeRefiner {
        maps: context.store.clone(),
        local: local::build(context).await?,
        model: mllm::shared(context).await?,
        settings: context.settings.cascade,
    }))
}

/// Returns a text that changes with everything that decides what the refiner finds.
pub(crate) fn fingerprint(settings: &RefinerSettings) -> Result<String, BuildError> {
    let cascade = serde_json::to_string(&settings.cascade)?;
    Ok(format!("{cascade} {}", mllm::fingerprint(settings)?))
}

impl CascadeRefiner {
    /// Builds a refiner over others.
    pub fn new(
        maps: Arc<dyn MapStore>,
        local: Arc<dyn Refiner>,
        model: Arc<MllmRefiner>,
        settings: CascadeSettings,
    ) -> Self {
        Self { maps, local, model, settings }
    }

    async fn calibration(&self, map: &Map) -> Result<Arc<Calibration>, RefineError> {
        Ok(self.maps.calibration(map).await?.unwrap_or_default())
    }

    /// Asks the model about some of the candidates. Its verdict replaces that of `local`, which stands if there is none.
    async fn ask(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
        first: LocalAnswer,
        candidates: &[usize],
    ) -> Result<Refinement, RefineError> {
        let chosen = candidates.iter().map(|&index| input.candidates[index].clone()).collect();
        // If only the call that ranks fails, the answer of `local` stands at once.
        let asked = RefineInput { candidates: chosen, attempts_left: 0, ..input.clone() };
        let counted = Counted { progress, spent: Mutex::default() };
        match self.model.refine_without_fallback(&asked, &counted).await {
            Ok(verdict) => self.merged(input, first, candidates, verdict).await,
            Err(deferred @ RefineError::Deferred { .. }) => Err(deferred),
            Err(RefineError::Permanent(why) | RefineError::Transient(why)) => {
                let degraded = format!("the answer is that of `local`: {why}");
                let usage = first.refinement.usage + *counted.spent.lock();
                Ok(Refinement { degraded: Some(degraded), usage, ..first.refinement })
            }
        }
    }

    /// Puts the candidates about which the model was asked first, in its order, and the others behind them in that of
    /// `local`.
    async fn merged(
        &self,
        input: &RefineInput,
        first: LocalAnswer,
        candidates: &[usize],
        verdict: Refinement,
    ) -> Result<Refinement, RefineError> {
        let LocalAnswer { refinement, order, agreement } = first;
        let descriptions =
            merged_descriptions(input, refinement.descriptions, verdict.descriptions);
        let usage = refinement.usage + verdict.usage;
        if verdict.reasoning.is_none() {
            // The model described pairs, but did not rank them.
            return Ok(Refinement {
                descriptions,
                usage,
                degraded: verdict.degraded,
                ranking: refinement.ranking,
                evidence: refinement.evidence,
                reasoning: refinement.reasoning,
                verdicts: refinement.verdicts,
                ..verdict
            });
        }
        let index_of =
            |image: &ImageId| input.candidates.iter().position(|one| one.image_id == *image);
        let asked = verdict.ranking.as_slice().iter().filter_map(|one| index_of(&one.image_id));
        let asked: Vec<usize> = asked.collect();
        let rest = order.iter().copied().filter(|index| !candidates.contains(index));
        let order: Vec<usize> = asked.iter().copied().chain(rest).collect();
        let ranking = Ranking::new(&input.candidates, &order)
            .map_err(|error| RefineError::Permanent(error.to_string()))?;
        // Measured among all candidates, as the null distribution of the map is.
        let evidence = match verdict.evidence {
            Some(none @ Evidence::NONE_OF_THESE) => Some(none),
            _ => asked.first().and_then(|&of| agreement.verdict(of, verdict.certainty)),
        };
        let calibration = self.calibration(&input.map).await?;
        let mut verdicts = refinement.verdicts;
        let confidence = ranking
            .first()
            .and_then(|first| input.confidence(&calibration, &first.image_id, evidence));
        verdicts.extend(ranking.first().map(|first| JobVerdict {
            refiner: RefinerKind::Mllm,
            image_id: first.image_id.clone(),
            confidence,
            evidence: evidence.filter(|_| confidence.is_none()),
            certainty: verdict.certainty,
            compared: asked.len(),
            then: None,
        }));
        Ok(Refinement { descriptions, ranking, evidence, usage, verdicts, ..verdict })
    }

    /// Returns what `local` found, with its verdict and what follows from it.
    async fn first(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<(LocalAnswer, Question), RefineError> {
        let mut refinement = self.local.refine(input, progress).await?;
        let agreement = refinement.agreement.take().unwrap_or_else(|| Agreement {
            regions: 0,
            matches: vec![0; input.candidates.len()],
            first: None,
            same_place: SamePlace::default(),
        });
        let index_of =
            |image: &ImageId| input.candidates.iter().position(|one| one.image_id == *image);
        let ranked = refinement.ranking.as_slice();
        let order: Vec<usize> = ranked.iter().filter_map(|one| index_of(&one.image_id)).collect();
        let calibration = self.calibration(&input.map).await?;
        let found = LocalFinding {
            candidates: &input.candidates,
            order: &order,
            agreement: &agreement,
            evidence: refinement.evidence,
        };
        let question = question(&self.settings, &calibration, &found);
        let then = match &question {
            Question::Settled { why } => format!("its answer stands: {why}"),
            Question::Open { why, candidates } => {
                let images =
                    candidates.iter().map(|&index| input.candidates[index].image_id.as_str());
                let images: Vec<&str> = images.collect();
                format!("the model was asked about {}: {why}", images.join(", "))
            }
        };
        let evidence = refinement.evidence;
        let confidence = ranked
            .first()
            .and_then(|first| input.confidence(&calibration, &first.image_id, evidence));
        refinement.verdicts.extend(ranked.first().map(|first| JobVerdict {
            refiner: RefinerKind::Local,
            image_id: first.image_id.clone(),
            confidence,
            evidence: evidence.filter(|_| confidence.is_none()),
            certainty: None,
            compared: order.len(),
            then: Some(then),
        }));
        Ok((LocalAnswer { refinement, order, agreement }, question))
    }
}

/// What `local` found.
struct LocalAnswer {
    refinement: Refinement,
    /// The indices of the candidates in its order.
    order: Vec<usize>,
    agreement: Agreement,
}

#[async_trait]
impl Refiner for CascadeRefiner {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Cascade
    }

    async fn refine(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let (first, question) = self.first(input, progress).await?;
        match question {
            Question::Settled { .. } => Ok(first.refinement),
            Question::Open { candidates, .. } => {
                self.ask(input, progress, first, &candidates).await
            }
        }
    }

    fn wants_descriptor(&self) -> bool {
        self.model.wants_descriptor()
    }

    fn region_matcher(&self) -> Option<&dyn RegionMatcher> {
        self.local.region_matcher()
    }

    fn negative_evidence(&self) -> Option<&dyn NegativeEvidence> {
        self.local.negative_evidence()
    }

    fn paid_negatives(&self) -> Option<&dyn PaidNegatives> {
        Some(self)
    }

    fn paid_calls(&self) -> Option<&dyn PaidCalls> {
        self.model.paid_calls()
    }

    async fn room(&self) {
        self.model.room().await;
    }
}

#[async_trait]
impl PaidNegatives for CascadeRefiner {
    fn cost(&self, candidates: usize) -> PaidMeasurement {
        self.model.cost(candidates.min(self.settings.candidates))
    }

    /// Asks about the candidates that would be in question, whether or not the answer of `local` would stand.
    async fn verdict(
        &self,
        map: &Map,
        negatives: &HardNegatives,
    ) -> Result<Option<Evidence>, RefineError> {
        let input = RefineInput::of_negatives(map, negatives, self.maps.as_ref()).await?;
        let Some(input) = input else { return Ok(None) };
        let (first, question) = self.first(&input, &Unwatched).await?;
        let agreement = first.agreement.clone();
        let candidates = match question {
            Question::Open { candidates, .. } => candidates,
            Question::Settled { .. } => question::in_question(&self.settings, &first.order),
        };
        let refinement = self.ask(&input, &Unwatched, first, &candidates).await?;
        // The order of `local`, or of a part of the pairs, is no verdict of the model.
        let is_verdict = refinement.degraded.is_none() && refinement.verdicts.len() > 1;
        let agreement = Some(agreement).filter(|_| is_verdict);
        Ok(agreement.and_then(|agreement| agreement.strongest_verdict(refinement.certainty)))
    }
}

/// Counts what the model costs, in case it fails in the end.
struct Counted<'a> {
    progress: &'a dyn Progress,
    spent: Mutex<Usage>,
}

#[async_trait]
impl Progress for Counted<'_> {
    async fn step(&self, step: Step) {
        *self.spent.lock() += step.usage;
        self.progress.step(step).await;
    }

    fn waiting(&self, waits: bool) {
        self.progress.waiting(waits);
    }
}

/// Returns one description for each candidate, in coarse order: that of the model where there is one.
fn merged_descriptions(
    input: &RefineInput,
    of_local: Vec<Description>,
    of_model: Vec<Description>,
) -> Vec<Description> {
    let find = |descriptions: &[Description], image: &ImageId| {
        descriptions.iter().find(|one| one.image_id == *image).cloned()
    };
    let images = input.candidates.iter().map(|candidate| &candidate.image_id);
    images.filter_map(|image| find(&of_model, image).or_else(|| find(&of_local, image))).collect()
}
