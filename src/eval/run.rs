//! Asks every query: retrieves as a server would, and hands the candidates to the refiners.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use async_trait::async_trait;
use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt};
use uuid::Uuid;

use super::cache_key::CacheKey;
use super::map::ReferenceMap;
use super::outcome::OutcomeCache;
use super::{Dataset, EvaluatedQuery, MethodOutcomes, Outcome, Prediction, Times};
use whereabouts_core::{Calibration, DescriptorKind, Digest, Map, RefinerKind, Scene, Usage};
use whereabouts_index::SearchMode;
use whereabouts_refine::{
    AttemptPolicy, DenseKey, Progress, QueryFrame, RefineError, RefineInput, Refinement, Refiner,
};
use whereabouts_service::{Retrieved, Service};
use whereabouts_store::Step;
use whereabouts_vision::{AdmissionRequest, FeatureSet};

/// A way to answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Method {
    /// What the coarse retriever compares.
    pub descriptor: DescriptorKind,
    /// Who orders its candidates anew.
    pub refiner: Option<RefinerKind>,
}

impl Method {
    /// Its name, as in `gem` and `gem+local`.
    pub fn name(&self) -> String {
        match self.refiner {
            Some(refiner) => format!("{}+{refiner}", self.descriptor),
            None => self.descriptor.to_string(),
        }
    }
}

/// How queries are asked.
#[derive(Debug, Clone)]
pub struct RunSettings {
    /// Candidates that are refined.
    pub k: usize,
    /// How the map is searched.
    pub search: SearchMode,
    /// What the pictures show.
    pub scene: Scene,
    /// Pictures in work at a time.
    pub side_by_side: usize,
    /// Where outcomes are kept.
    pub work: PathBuf,
    /// How often a refinement is attempted.
    pub attempts: AttemptPolicy,
    /// All else that decides what the refiners find; part of the names of files.
    pub refiner_settings: String,
}

/// Hears how far a run has come.
pub trait Watch: Send + Sync {
    /// So many of these are to be done.
    fn begin(&self, what: &str, total: usize);
    /// One of them is done.
    fn step(&self);
    /// All are done.
    fn end(&self);
}

/// Runs methods with the parts of a service.
pub struct Evaluator<'a> {
    /// The service, on the work folder.
    pub service: Arc<Service>,
    /// Who refines.
    pub refiners: Vec<Arc<dyn Refiner>>,
    /// How queries are asked.
    pub settings: RunSettings,
    /// Hears how far it has come.
    pub watch: &'a dyn Watch,
}

/// Answers that are kept are the service's answers to k = 10 at least, for the field's Recall@10.
const LEAST_ANSWERS: usize = 10;

impl Evaluator<'_> {
    /// The outcomes of the coarse method with this descriptor, and of each refiner on top of it.
    pub async fn run(
        &self,
        data: &Dataset,
        descriptor: DescriptorKind,
    ) -> anyhow::Result<Vec<MethodOutcomes>> {
        let references = self.reference_map(&data.references, descriptor).await?;
        let calibration = self.calibrated(&references.map).await?;
        let kinds = self.refiners.iter().map(|refiner| Some(refiner.kind()));
        let methods: Vec<Method> =
            [None].into_iter().chain(kinds).map(|refiner| Method { descriptor, refiner }).collect();
        let kept = methods
            .iter()
            .map(|method| self.kept(*method, &references))
            .collect::<anyhow::Result<Vec<OutcomeCache>>>()?;

        self.watch.begin("queries", data.queries.len());
        let mut outcomes: Vec<Vec<Outcome>> = methods.iter().map(|_| Vec::new()).collect();
        let mut asked = futures_util::stream::iter(&data.queries)
            .map(|query| self.ask(&references.map, &calibration, query, &kept))
            .buffered(self.settings.side_by_side);
        while let Some(found) = asked.try_next().await? {
            outcomes.iter_mut().zip(found).for_each(|(all, one)| all.push(one));
            self.watch.step();
        }
        self.watch.end();
        let outcomes = methods.into_iter().zip(outcomes);
        Ok(outcomes.map(|(method, outcomes)| MethodOutcomes { method, outcomes }).collect())
    }

    /// The file of a method's outcomes.
    fn kept(&self, method: Method, references: &ReferenceMap) -> anyhow::Result<OutcomeCache> {
        let RunSettings { k, search, scene, refiner_settings, work, .. } = &self.settings;
        let decides = CacheKey {
            version: env!("CARGO_PKG_VERSION"),
            map: &references.map.name,
            references: references.digest,
            search: *search,
            k: *k,
            refinement: method.refiner.map(|_| (*scene, refiner_settings.as_str())),
            calibration: self.service.calibrator.settings,
        }
        .text();
        let folder = work.join("outcomes");
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        let digest = Digest::of(decides.as_bytes()).hex();
        OutcomeCache::open(&folder.join(format!("{}-{}.jsonl", method.name(), &digest[..16])))
    }

    /// What chance resemblance is like in the map. Measured anew each time: what an earlier run kept may
    /// be of other references.
    async fn calibrated(&self, map: &Map) -> anyhow::Result<Arc<Calibration>> {
        let measures = self.refiners.iter().find_map(|refiner| refiner.negative_evidence());
        self.service.calibrator.calibrate(map, measures).await?;
        Ok(self.service.maps.store.calibration(map).await?.unwrap_or_default())
    }

    /// The outcome of each method for one query; what is kept is not worked out again.
    async fn ask(
        &self,
        map: &Map,
        calibration: &Calibration,
        query: &EvaluatedQuery,
        kept: &[OutcomeCache],
    ) -> anyhow::Result<Vec<Outcome>> {
        let named = || query.picture.file.display().to_string();
        let frame: Bytes = tokio::fs::read(&query.picture.file).await.with_context(named)?.into();
        let digest = Digest::of(&frame);
        let known: Vec<Option<Outcome>> =
            kept.iter().map(|kept| kept.get(&query.picture.id, digest)).collect();
        if known.iter().all(Option::is_some) {
            return Ok(known.into_iter().flatten().collect());
        }
        let wanted = self.settings.k.max(LEAST_ANSWERS);
        let refines_locally =
            self.refiners.iter().any(|refiner| refiner.kind() == RefinerKind::Local);
        let features = match refines_locally {
            true => FeatureSet::DescriptorAndDense,
            false => FeatureSet::DescriptorOnly,
        };
        let search = (wanted, self.settings.search);
        let retrieved = self
            .service
            .localizer
            .retrieve(&map.name, &frame, search, features, AdmissionRequest::BACKGROUND)
            .await
            .with_context(named)?;
        let coarse = coarse(query, digest, &retrieved, calibration);
        let mut outcomes = Vec::with_capacity(kept.len());
        let input = self.input(map, digest, retrieved);
        // The refiners fetch the frame from the store; the pin keeps it there meanwhile.
        let _pin = self.service.images.blobs.put_blob(digest, frame).await?;
        for (place, (known, kept)) in known.into_iter().zip(kept).enumerate() {
            let outcome = match (known, place.checked_sub(1)) {
                (Some(known), _) => known,
                (None, None) => coarse.clone(),
                (None, Some(refiner)) => {
                    let refiner = self.refiners[refiner].as_ref();
                    self.refine(refiner, &input, &coarse, calibration).await.with_context(named)?
                }
            };
            kept.keep(&outcome)?;
            outcomes.push(outcome);
        }
        Ok(outcomes)
    }

    /// The input of the job that a server would have queued.
    fn input(&self, map: &Map, digest: Digest, retrieved: Retrieved) -> RefineInput {
        let Retrieved { model, mut candidates, extraction, .. } = retrieved;
        candidates.truncate(self.settings.k);
        let key = DenseKey { model, picture: digest };
        if let Some(dense) = extraction.dense {
            self.service.dense.insert(key, Arc::new(dense));
        }
        RefineInput {
            id: Uuid::now_v7(),
            map: map.clone(),
            frame: QueryFrame {
                query_id: Uuid::now_v7(),
                digest,
                descriptor: Some(extraction.descriptor),
            },
            candidates,
            spent: Usage::default(),
        }
    }

    async fn refine(
        &self,
        refiner: &dyn Refiner,
        input: &RefineInput,
        coarse: &Outcome,
        calibration: &Calibration,
    ) -> anyhow::Result<Outcome> {
        let mut input = input.clone();
        input.frame.descriptor.take_if(|_| !refiner.wants_descriptor());
        let attempt = || async {
            let start = Instant::now();
            Ok((refiner.refine(&input, &NoProgress).await?, start.elapsed()))
        };
        match self.settings.attempts.run(attempt).await {
            Ok((refinement, took)) => {
                let confidence = refinement.ranking.first().map_or(0.0, |first| {
                    calibration.refined_confidence(
                        &input.candidates,
                        &first.image_id,
                        refinement.evidence,
                    )
                });
                Ok(refined(coarse, refinement, confidence, took))
            }
            Err(RefineError::Deferred { why, after }) => bail!(
                "{why}; what was found so far is kept: run the same command again in {} s",
                after.as_secs()
            ),
            Err(RefineError::Transient(why) | RefineError::Permanent(why)) => {
                Ok(Outcome { degraded: Some(why), ..coarse.clone() })
            }
        }
    }
}

fn coarse(
    query: &EvaluatedQuery,
    digest: Digest,
    retrieved: &Retrieved,
    calibration: &Calibration,
) -> Outcome {
    let times = retrieved.extraction.times;
    let candidates = &retrieved.candidates;
    let first = candidates.first();
    let answers = retrieved.candidates.iter().map(|candidate| Prediction {
        image_id: candidate.image_id.clone(),
        similarity: candidate.similarity,
        coarse_rank: candidate.rank,
    });
    Outcome {
        query: query.picture.id.clone(),
        digest,
        answers: answers.collect(),
        confidence: first
            .map_or(0.0, |first| calibration.refined_confidence(candidates, &first.image_id, None)),
        descriptions: Vec::new(),
        reasoning: None,
        usage: Usage::default(),
        times: Times {
            decode: ms(times.decode),
            extract: ms(times.extract),
            search: ms(retrieved.searched),
            ..Times::default()
        },
        degraded: None,
    }
}

/// The refined candidates first, those that were not refined behind them in coarse order.
fn refined(coarse: &Outcome, refinement: Refinement, confidence: f32, took: Duration) -> Outcome {
    let ranking = refinement.ranking.as_slice();
    let at = |rank: usize| coarse.answers.iter().find(|answer| answer.coarse_rank == rank);
    let first = ranking.iter().filter_map(|place| at(place.coarse_rank));
    let rest = coarse.answers.iter().filter(|answer| answer.coarse_rank > ranking.len());
    Outcome {
        answers: first.chain(rest).cloned().collect(),
        confidence,
        times: Times { refine: ms(took), pairs: ranking.len(), ..coarse.times },
        descriptions: refinement.descriptions,
        reasoning: refinement.reasoning,
        usage: refinement.usage,
        degraded: refinement.degraded,
        ..coarse.clone()
    }
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

/// Nobody watches a single job of an evaluation.
struct NoProgress;

#[async_trait]
impl Progress for NoProgress {
    async fn step(&self, _: Step) {}
}
