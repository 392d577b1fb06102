//! Asks every query: retrieves as a server would, and hands the candidates to the refiners.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use async_trait::async_trait;
use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt};
use jiff::Timestamp;
use uuid::Uuid;

use super::map::ReferenceMap;
use super::outcome::OutcomeCache;
use super::{Dataset, EvaluatedQuery, MethodOutcomes, Outcome, Prediction, Times};
use whereabouts_core::{Calibration, DescriptorKind, Digest, Job, Map, RefinerKind, Scene, Usage};
use whereabouts_index::SearchMode;
use whereabouts_refine::{DenseKey, Progress, RefineError, Refinement, Refiner};
use whereabouts_service::{Retrieved, Service};
use whereabouts_store::{JobRecord, Query, Step};
use whereabouts_vision::AdmissionRequest;

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
    /// How often a refinement is tried.
    pub attempts: u32,
    /// The pause before the second try; it doubles each time.
    pub retry_pause: Duration,
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
        let refined = method.refiner.map(|_| (scene, refiner_settings));
        let decides = format!(
            "{}\n{}\n{}\n{:?}\n{k}\n{refined:?}\n{:?}",
            env!("CARGO_PKG_VERSION"),
            references.map.name,
            references.digest,
            search,
            self.service.calibrator.settings
        );
        let folder = work.join("outcomes");
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        let digest = Digest::of(decides.as_bytes()).hex();
        OutcomeCache::open(&folder.join(format!("{}-{}.jsonl", method.name(), &digest[..16])))
    }

    /// What chance resemblance is like in the map. Measured anew each time: what an earlier run kept may
    /// be of other references.
    async fn calibrated(&self, map: &Map) -> anyhow::Result<Arc<Calibration>> {
        let local = self.refiners.iter().find(|refiner| refiner.kind() == RefinerKind::Local);
        self.service.calibrator.calibrate(map, local.map(AsRef::as_ref)).await?;
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
        let retrieved = self
            .service
            .localizer
            .retrieve(&map.name, &frame, wanted, self.settings.search, AdmissionRequest::BACKGROUND)
            .await
            .with_context(named)?;
        let coarse = coarse(query, digest, &retrieved, calibration);
        let mut outcomes = Vec::with_capacity(kept.len());
        let record = self.record(map, digest, retrieved);
        // The refiners fetch the frame from the store; the pin keeps it there meanwhile.
        let _pin = self.service.images.blobs.put_blob(digest, frame).await?;
        for (place, (known, kept)) in known.into_iter().zip(kept).enumerate() {
            let outcome = match (known, place.checked_sub(1)) {
                (Some(known), _) => known,
                (None, None) => coarse.clone(),
                (None, Some(refiner)) => {
                    let refiner = self.refiners[refiner].as_ref();
                    self.refine(refiner, &record, &coarse, calibration).await.with_context(named)?
                }
            };
            kept.keep(&outcome)?;
            outcomes.push(outcome);
        }
        Ok(outcomes)
    }

    /// The job that a server would have queued.
    fn record(&self, map: &Map, digest: Digest, retrieved: Retrieved) -> JobRecord {
        let Retrieved { model, mut candidates, extraction, .. } = retrieved;
        candidates.truncate(self.settings.k);
        let key = DenseKey { model, picture: digest };
        self.service.dense.insert(key, Arc::new(extraction.dense));
        let now = Timestamp::now();
        let query = Query {
            id: Uuid::now_v7(),
            digest,
            media_type: extraction.media_type,
            created_at: now,
            descriptor: Some(extraction.descriptor),
        };
        let job = Job::queued(map.name.clone(), query.id, RefinerKind::Local, now);
        JobRecord {
            job,
            map_uid: map.uid,
            revision: map.revision,
            query,
            candidates,
            claims: 0,
            traceparent: None,
        }
    }

    async fn refine(
        &self,
        refiner: &dyn Refiner,
        record: &JobRecord,
        coarse: &Outcome,
        calibration: &Calibration,
    ) -> anyhow::Result<Outcome> {
        let mut record = record.clone();
        record.job.refiner = refiner.kind();
        if !refiner.wants_descriptor() {
            record.query.descriptor = None;
        }
        let mut tries = 1;
        loop {
            let start = Instant::now();
            match refiner.refine(&record, &NoProgress).await {
                Ok(refinement) => {
                    let took = start.elapsed();
                    let confidence = refinement.ranking.first().map_or(0.0, |first| {
                        calibration.refined_confidence(
                            &record.candidates,
                            &first.image_id,
                            refinement.evidence,
                        )
                    });
                    return Ok(refined(coarse, refinement, confidence, took));
                }
                Err(RefineError::Deferred { why, after }) => bail!(
                    "{why}; what was found so far is kept: run the same command again in {} s",
                    after.as_secs()
                ),
                Err(RefineError::Transient(_)) if tries < self.settings.attempts => {
                    let pause = self.settings.retry_pause * 2_u32.saturating_pow(tries - 1);
                    tokio::time::sleep(pause).await;
                    tries += 1;
                }
                Err(RefineError::Transient(why) | RefineError::Permanent(why)) => {
                    return Ok(Outcome { degraded: Some(why), ..coarse.clone() });
                }
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
