//! Evaluates every query: retrieves as a server would, and passes the candidates to the refiners.

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
use super::{
    AlternativeConfidence, Dataset, EvaluatedQuery, MethodOutcomes, Prediction, QueryOutcome,
    StageTimes,
};
use whereabouts_core::{
    Calibration, Certainty, DescriptorKind, Digest, Map, Priority, RefinerKind, Scene, Usage,
};
use whereabouts_index::SearchMode;
use whereabouts_refine::{
    AttemptPolicy, DenseKey, FrameReader, FrameTexts, Progress, QueryFrame, RefineError,
    RefineInput, Refinement, Refiner,
};
use whereabouts_service::{Retrieved, Service};
use whereabouts_store::Step;
use whereabouts_vision::{AdmissionRequest, FeatureSet};

/// A way to localize a query: coarse retrieval, with or without refinement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Method {
    /// The descriptor that coarse retrieval compares.
    pub descriptor: DescriptorKind,
    /// The refiner of the candidates; `None` for coarse retrieval alone.
    pub refiner: Option<RefinerKind>,
}

impl Method {
    /// Returns the name, such as `gem` or `gem+local`.
    pub fn name(&self) -> String {
        match self.refiner {
            Some(refiner) => format!("{}+{refiner}", self.descriptor),
            None => self.descriptor.to_string(),
        }
    }
}

/// How queries are evaluated.
#[derive(Debug, Clone)]
pub struct RunSettings {
    /// Number of candidates to refine.
    pub k: usize,
    /// How the map is searched.
    pub search: SearchMode,
    /// What the images show.
    pub scene: Scene,
    /// Number of images processed concurrently.
    pub concurrency: usize,
    /// Folder for the map and the cached outcomes.
    pub work_dir: PathBuf,
    /// Attempts at one refinement, and the pauses between them.
    pub attempts: AttemptPolicy,
    /// Everything else that determines what the refiners return; part of the key of cached outcomes.
    pub refiner_settings: String,
}

/// Observes the progress of a run.
pub trait Observer: Send + Sync {
    /// A phase with `total` items begins; `what` names the items in the plural.
    fn begin(&self, what: &str, total: usize);
    /// One item of the phase is done.
    fn step(&self);
    /// The phase is complete.
    fn finish(&self);
}

/// Evaluates methods with the parts of a service.
pub struct Evaluator<'a> {
    /// A service on the work folder.
    pub service: Arc<Service>,
    /// The refiners to evaluate.
    pub refiners: Vec<Arc<dyn Refiner>>,
    /// How queries are evaluated.
    pub settings: RunSettings,
    /// Observes the progress.
    pub observer: &'a dyn Observer,
}

/// Fewest predictions per query: Recall@10 needs ten.
const MIN_PREDICTIONS: usize = 10;

impl Evaluator<'_> {
    /// Evaluates the coarse method with this descriptor, and each refiner on top of it.
    ///
    /// # Errors
    /// An image or the work folder cannot be read or written, retrieval fails, or a refiner has to be asked again
    /// later. What was found until then is cached.
    pub async fn run(
        &self,
        data: &Dataset,
        descriptor: DescriptorKind,
    ) -> anyhow::Result<Vec<MethodOutcomes>> {
        let references = self.reference_map(&data.references, descriptor).await?;
        self.read(&references.map, data.references.len()).await?;
        let calibration = self.calibrate(&references.map).await?;
        let kinds = self.refiners.iter().map(|refiner| Some(refiner.kind()));
        let methods: Vec<Method> =
            [None].into_iter().chain(kinds).map(|refiner| Method { descriptor, refiner }).collect();
        let caches = methods
            .iter()
            .map(|method| self.open_cache(*method, &references))
            .collect::<anyhow::Result<Vec<OutcomeCache>>>()?;

        self.observer.begin("queries", data.queries.len());
        let mut by_method: Vec<Vec<QueryOutcome>> = methods.iter().map(|_| Vec::new()).collect();
        let mut evaluated = futures_util::stream::iter(&data.queries)
            .map(|query| self.evaluate(&references.map, &calibration, query, &caches))
            .buffered(self.settings.concurrency);
        while let Some(outcomes) = evaluated.try_next().await? {
            by_method.iter_mut().zip(outcomes).for_each(|(all, outcome)| all.push(outcome));
            self.observer.step();
        }
        self.observer.finish();
        let by_method = methods.into_iter().zip(by_method);
        Ok(by_method.map(|(method, outcomes)| MethodOutcomes { method, outcomes }).collect())
    }

    /// Opens the cache of a method's outcomes.
    fn open_cache(
        &self,
        method: Method,
        references: &ReferenceMap,
    ) -> anyhow::Result<OutcomeCache> {
        let RunSettings { k, search, scene, refiner_settings, work_dir, .. } = &self.settings;
        let key = CacheKey {
            version: env!("CARGO_PKG_VERSION"),
            map: &references.map.name,
            references: references.digest,
            search: *search,
            k: *k,
            refinement: method.refiner.map(|_| (*scene, refiner_settings.as_str())),
            calibration: self.service.calibrator.settings,
            vocabulary: references.map.vocabulary.map(|own| own.digest),
            reader: method.refiner.and_then(|_| self.service.reading.digest()),
        }
        .text();
        let folder = work_dir.join("outcomes");
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create the folder {}", folder.display()))?;
        let digest = Digest::of(key.as_bytes()).hex();
        OutcomeCache::open(&folder.join(format!("{}-{}.jsonl", method.name(), &digest[..16])))
    }

    /// Reads the text in the references, if a refiner compares it with that of the frames.
    async fn read(&self, map: &Map, images: usize) -> anyhow::Result<()> {
        if self.reads() {
            self.observer.begin("references to read", images);
            self.service.reading.read_map(map, || self.observer.step()).await?;
            self.observer.finish();
        }
        Ok(())
    }

    /// Whether text in pictures is compared: whether there is a reader and `local`, alone or in a cascade.
    fn reads(&self) -> bool {
        let compares = |refiner: &Arc<dyn Refiner>| refiner.kind() != RefinerKind::Mllm;
        self.service.reading.is_installed() && self.refiners.iter().any(compares)
    }

    /// Measures the null distribution of the map. A calibration in the store is not reused: it may be of
    /// other references.
    async fn calibrate(&self, map: &Map) -> anyhow::Result<Arc<Calibration>> {
        let refiners = self.refiners.iter().map(AsRef::as_ref);
        // One with a paid model measures what the others do, too.
        let refiner = refiners.max_by_key(|refiner: &&dyn Refiner| {
            let asks_about_all = refiner.kind() == RefinerKind::Mllm;
            (
                refiner.paid_negatives().is_some(),
                asks_about_all,
                refiner.negative_evidence().is_some(),
            )
        });
        self.service.calibrator.calibrate(map, refiner).await?;
        Ok(self.service.maps.store.calibration(map).await?.unwrap_or_default())
    }

    /// Returns the outcome of each method for one query, from the cache where it is there.
    async fn evaluate(
        &self,
        map: &Map,
        calibration: &Calibration,
        query: &EvaluatedQuery,
        caches: &[OutcomeCache],
    ) -> anyhow::Result<Vec<QueryOutcome>> {
        let file = || query.picture.file.display().to_string();
        let frame: Bytes = tokio::fs::read(&query.picture.file).await.with_context(file)?.into();
        let digest = Digest::of(&frame);
        let cached: Vec<Option<QueryOutcome>> =
            caches.iter().map(|cache| cache.get(&query.picture.id, digest)).collect();
        if cached.iter().all(Option::is_some) {
            return Ok(cached.into_iter().flatten().collect());
        }
        let k = self.settings.k.max(MIN_PREDICTIONS);
        let refines_locally =
            self.refiners.iter().any(|refiner| refiner.kind() != RefinerKind::Mllm);
        let features = match refines_locally {
            true => FeatureSet::DescriptorAndDense,
            false => FeatureSet::DescriptorOnly,
        };
        let search = (k, self.settings.search);
        let retrieved = self
            .service
            .localizer
            .retrieve(&map.name, &frame, search, features, AdmissionRequest::BACKGROUND)
            .await
            .with_context(file)?;
        let coarse = coarse_outcome(query, digest, &retrieved, calibration);
        let mut outcomes = Vec::with_capacity(caches.len());
        let input = self.refine_input(map, digest, retrieved);
        // The refiners fetch the frame from the store; the pin protects it from removal until then.
        let _pin = self.service.images.blobs.put_blob(digest, frame).await?;
        for (index, (cached, cache)) in cached.into_iter().zip(caches).enumerate() {
            // The first method is the coarse one, the others are the refiners in their order.
            let outcome = match (cached, index.checked_sub(1)) {
                (Some(cached), _) => cached,
                (None, None) => coarse.clone(),
                (None, Some(refiner)) => {
                    let refiner = self.refiners[refiner].as_ref();
                    self.refine(refiner, &input, &coarse, calibration).await.with_context(file)?
                }
            };
            cache.insert(&outcome)?;
            outcomes.push(outcome);
        }
        Ok(outcomes)
    }

    /// Builds the input of the job that a server would have queued for the query.
    fn refine_input(&self, map: &Map, digest: Digest, retrieved: Retrieved) -> RefineInput {
        let Retrieved { model, mut candidates, extraction, .. } = retrieved;
        candidates.truncate(self.settings.k);
        let key = DenseKey { model, picture: digest };
        if let Some(dense) = extraction.dense {
            self.service.dense.insert(key, Arc::new(dense));
        }
        RefineInput {
            id: Uuid::now_v7(),
            map: map.clone(),
            refiner: None,
            frame: QueryFrame {
                query_id: Uuid::now_v7(),
                digest,
                descriptor: Some(extraction.descriptor),
                uninformative: extraction.information.lack().is_some(),
                texts: match self.reads() {
                    true => {
                        let (reading, name) = (Arc::clone(&self.service.reading), map.name.clone());
                        FrameTexts::of(async move { reading.read_frame(&name, &digest).await })
                    }
                    false => FrameTexts::default(),
                },
            },
            candidates,
            priority: Priority::Normal,
            attempts_left: 0,
            spent: Usage::default(),
            fresh_since: None,
        }
    }

    /// Refines one query, with retries. A refiner that fails for good leaves the coarse ranking.
    async fn refine(
        &self,
        refiner: &dyn Refiner,
        input: &RefineInput,
        coarse: &QueryOutcome,
        calibration: &Calibration,
    ) -> anyhow::Result<QueryOutcome> {
        let mut input = input.clone();
        input.frame.descriptor.take_if(|_| !refiner.wants_descriptor());
        let attempt = || async {
            let start = Instant::now();
            Ok((refiner.refine(&input, &NoProgress).await?, start.elapsed()))
        };
        match self.settings.attempts.run(attempt).await {
            Ok((refinement, elapsed)) => {
                let confidence = |evidence| {
                    let first = &refinement.ranking.first()?.image_id;
                    input.confidence(calibration, first, evidence)
                };
                let (refined, similarity) = (confidence(refinement.evidence), confidence(None));
                let asks_a_model = refiner.paid_negatives().is_some();
                let alternatives = asks_a_model.then(|| AlternativeConfidence {
                    similarity: similarity.unwrap_or_default(),
                    stated: stated(refinement.certainty),
                });
                let outcome = refined_outcome(coarse, refinement, refined, elapsed);
                Ok(QueryOutcome { alternatives, ..outcome })
            }
            Err(RefineError::Deferred { why, after }) => bail!(
                "{why}; the outcomes so far are saved: run the same command again in {} s",
                after.as_secs()
            ),
            Err(RefineError::Transient(why) | RefineError::Permanent(why)) => {
                Ok(QueryOutcome { degraded: Some(why), ..coarse.clone() })
            }
        }
    }
}

/// Takes a model's certainty at its word.
fn stated(certainty: Option<Certainty>) -> f32 {
    match certainty {
        Some(Certainty::Certain) => 1.0,
        Some(Certainty::Likely) => 0.75,
        None => 0.5,
        Some(Certainty::Unsure) => 0.25,
        Some(Certainty::None) => 0.0,
    }
}

fn coarse_outcome(
    query: &EvaluatedQuery,
    digest: Digest,
    retrieved: &Retrieved,
    calibration: &Calibration,
) -> QueryOutcome {
    let times = retrieved.extraction.times;
    let candidates = &retrieved.candidates;
    let predictions = candidates.iter().map(|candidate| Prediction {
        image_id: candidate.image_id.clone(),
        similarity: candidate.similarity,
        coarse_rank: candidate.rank,
    });
    QueryOutcome {
        query: query.picture.id.clone(),
        digest,
        predictions: predictions.collect(),
        confidence: match retrieved.extraction.information.lack() {
            Some(_) => Some(0.0),
            None => candidates.first().and_then(|first| {
                calibration.refined_confidence(candidates, &first.image_id, None)
            }),
        },
        alternatives: None,
        descriptions: Vec::new(),
        reasoning: None,
        usage: Usage::default(),
        times: StageTimes {
            decode: ms(times.decode),
            extract: ms(times.extract),
            search: ms(retrieved.searched),
            ..StageTimes::default()
        },
        degraded: None,
    }
}

/// Puts the refined candidates first, followed by those that were not refined, in coarse order. An order that
/// another refiner found counts as none: it is not the work of the method.
fn refined_outcome(
    coarse: &QueryOutcome,
    refinement: Refinement,
    confidence: Option<f32>,
    elapsed: Duration,
) -> QueryOutcome {
    if refinement.ordered_by.is_some() {
        return QueryOutcome {
            times: StageTimes { refine: ms(elapsed), ..coarse.times },
            descriptions: refinement.descriptions,
            usage: refinement.usage,
            degraded: refinement.degraded,
            ..coarse.clone()
        };
    }
    let ranking = refinement.ranking.as_slice();
    let at_rank = |rank: usize| coarse.predictions.iter().find(|one| one.coarse_rank == rank);
    let refined = ranking.iter().filter_map(|ranked| at_rank(ranked.coarse_rank));
    let rest = coarse.predictions.iter().filter(|one| one.coarse_rank > ranking.len());
    QueryOutcome {
        predictions: refined.chain(rest).cloned().collect(),
        confidence,
        times: StageTimes { refine: ms(elapsed), pairs: ranking.len(), ..coarse.times },
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

/// Ignores the progress of single jobs; the evaluation reports that of whole queries.
struct NoProgress;

#[async_trait]
impl Progress for NoProgress {
    async fn step(&self, _: Step) {}
}
