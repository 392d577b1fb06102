//! The refiner `local`: fetches dense features, has them matched, and turns the matches into a ranking.

use std::sync::Arc;

use async_trait::async_trait;
use futures_util::{StreamExt, TryStreamExt, stream};
use tokio::sync::Semaphore;
use whereabouts_core::{
    Agreement, CalibrationSettings, Candidate, Certainty, Description, Digest, Evidence, ImageId,
    Map, PairRegion, Pose, Ranking, RefinerKind, SamePlace, TextLine, Usage,
};
use whereabouts_store::{BlobStore, HardNegatives, MapStore, TextStore};
use whereabouts_vision::{CpuPool, Extractor, LoadedModels, ModelError};

use super::comparison::{Comparison, agreement, is_clear};
use super::matching::{FeatureSource, Matching, joined};
use super::signs::{self, SignEvidence};
use super::{
    LocalMatcher, LocalSettings, Match, PairMatch, Standing, describe, describe_signs, rank,
};
use crate::{
    BuildError, DenseCache, DenseKey, NegativeEvidence, Progress, RefineError, RefineInput,
    Refinement, Refiner, RefinerContext, RefinerSettings, RegionMatcher, milliseconds,
};

/// Pictures of one job that are fetched from the blob store at a time.
const CONCURRENT_FETCHES: usize = 8;

/// Geometric matching of dense features, on this machine.
pub struct LocalRefiner {
    maps: Arc<dyn MapStore>,
    blobs: Arc<dyn BlobStore>,
    /// What was read in the images of maps.
    texts: Arc<dyn TextStore>,
    /// Extracts dense features that the cache does not hold.
    models: LoadedModels,
    dense: Arc<DenseCache>,
    /// The threads that extract and match.
    pool: CpuPool,
    /// One permit for each of these threads, so that jobs wait here, where they hold no pictures, and do not fill the
    /// pool's queue.
    turns: Semaphore,
    matcher: LocalMatcher,
    /// The confidence from which a place is known.
    known_from: f64,
    /// Which images count as the same place.
    places: CalibrationSettings,
}

/// Builds the refiner `local`.
pub(crate) async fn build(context: &RefinerContext) -> Result<Arc<dyn Refiner>, BuildError> {
    Ok(Arc::new(LocalRefiner {
        maps: context.store.clone(),
        blobs: context.store.clone(),
        texts: context.store.clone(),
        models: context.models.clone(),
        dense: Arc::clone(&context.dense),
        turns: Semaphore::new(context.pool.threads()),
        pool: context.pool.clone(),
        matcher: LocalMatcher::new(LocalSettings::default()),
        known_from: context.settings.known_confidence,
        places: context.settings.places,
    }))
}

/// Returns a text that changes with everything that decides what the refiner finds.
pub(crate) fn fingerprint(_: &RefinerSettings) -> Result<String, BuildError> {
    Ok(serde_json::to_string(&LocalSettings::default())?)
}

#[async_trait]
impl Refiner for LocalRefiner {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Local
    }

    async fn refine(
        &self,
        input: &RefineInput,
        _: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let mut comparison = {
            // Cannot fail, because the semaphore is never closed.
            let _turn = self.turns.acquire().await;
            self.compare_input(input).await?
        };
        let frame = input.frame.texts.get().await.unwrap_or_default();
        let signs = self.signs(input, &frame, &comparison).await?;
        if let Some(signs) = &signs {
            let shares: Vec<f32> = comparison.pairs.iter().map(|pair| pair.score).collect();
            comparison.order = signs::order(&comparison.order, &shares, signs);
        }
        // The words of a description follow from the calibration. An answer in other words is better than none.
        let calibration = self.maps.calibration(&input.map).await.ok().flatten();
        let calibration = calibration.unwrap_or_default();
        let signs = signs.map(|signs| Signs { frame: &frame, of: signs });
        conclude(&input.candidates, &comparison, signs.as_ref(), |evidence| Standing {
            confidence: match input.frame.uninformative {
                true => None,
                false => evidence.and_then(|evidence| calibration.confidence(evidence)),
            },
            known_from: self.known_from,
        })
    }

    fn region_matcher(&self) -> Option<&dyn RegionMatcher> {
        Some(self)
    }

    fn negative_evidence(&self) -> Option<&dyn NegativeEvidence> {
        Some(self)
    }
}

#[async_trait]
impl RegionMatcher for LocalRefiner {
    async fn regions(
        &self,
        input: &RefineInput,
        image: &ImageId,
    ) -> Result<Option<Vec<PairRegion>>, RefineError> {
        // Matches depend on the other candidates, so all are compared, as they were in the job.
        let Comparison { present, pairs, .. } = self.compare_input(input).await?;
        let of = present.iter().position(|&index| input.candidates[index].image_id == *image);
        let matches = of.and_then(|of| pairs.into_iter().nth(of)).map(|pair| pair.matches);
        let region = |found: Match| PairRegion {
            frame: found.query,
            image: found.candidate,
            similarity: found.similarity,
        };
        Ok(matches.map(|matches| matches.into_iter().map(region).collect()))
    }

    async fn agreement(&self, input: &RefineInput) -> Result<Agreement, RefineError> {
        let _turn = self.turns.acquire().await;
        Ok(self.compare_input(input).await?.agreement_of_all())
    }
}

#[async_trait]
impl NegativeEvidence for LocalRefiner {
    async fn best_negative(
        &self,
        map: &Map,
        negatives: &HardNegatives,
    ) -> Result<Vec<Evidence>, RefineError> {
        let extractor = self.models.of(map).await.map_err(no_model)?;
        let query = match self.maps.image(map, &negatives.image_id).await? {
            Some(image) => {
                self.source(DenseKey { model: extractor.identity(), picture: image.digest }).await?
            }
            None => None,
        };
        let Some(query) = query else { return Ok(Vec::new()) };
        let agreement = self.compare(map, extractor, query, &negatives.others).await?.agreement();
        let own = agreement.first.and_then(|first| agreement.evidence(first));
        // Of a model that was not asked, the worst is assumed.
        let worst = agreement.strongest_verdict(Some(Certainty::Certain));
        Ok(own.into_iter().chain(worst).collect())
    }
}

impl LocalRefiner {
    async fn compare_input(&self, input: &RefineInput) -> Result<Comparison, RefineError> {
        let extractor = self.models.of(&input.map).await.map_err(no_model)?;
        let frame = DenseKey { model: extractor.identity(), picture: input.frame.digest };
        let query = self
            .source(frame)
            .await?
            .ok_or_else(|| RefineError::Permanent("the frame is missing from the store".into()))?;
        self.compare(&input.map, extractor, query, &input.candidates).await
    }

    /// What the signs say about the candidates that are present; `None` if they say nothing.
    async fn signs(
        &self,
        input: &RefineInput,
        frame: &[TextLine],
        comparison: &Comparison,
    ) -> Result<Option<Vec<SignEvidence>>, RefineError> {
        if frame.is_empty() {
            return Ok(None);
        }
        let present = comparison.present.iter();
        let ids: Vec<ImageId> =
            present.map(|&index| input.candidates[index].image_id.clone()).collect();
        let texts = self.texts.texts(&input.map, &ids).await?;
        let lines: Vec<_> = texts.into_iter().map(|texts| Some(texts?.lines)).collect();
        Ok(signs::evidence(frame, &lines))
    }

    async fn compare(
        &self,
        map: &Map,
        extractor: Arc<Extractor>,
        query: FeatureSource,
        candidates: &[Candidate],
    ) -> Result<Comparison, RefineError> {
        let (mut matching, mut present, mut considered) = (Matching::of(query), Vec::new(), 0);
        let mut early = Vec::new();
        let (places, images) = self.places_of(map, candidates).await?;
        let same_place = |present: &[usize]| {
            let places: Vec<_> = present.iter().map(|&index| places[index]).collect();
            SamePlace::of(&places, images, &self.places)
        };
        let first = self.matcher.settings.first.min(candidates.len());
        for end in [first, candidates.len()] {
            let group = &candidates[considered..end];
            let found = self.candidate_sources(map, extractor.identity(), group).await?;
            let mut sources = Vec::new();
            for (index, source) in found.into_iter().enumerate() {
                if let Some(source) = source {
                    present.push(considered + index);
                    sources.push(source);
                }
            }
            considered = end;
            let (dense, matcher) = (Arc::clone(&self.dense), self.matcher.clone());
            let extractor = Arc::clone(&extractor);
            matching = self
                .pool
                .run(move || matching.extended(&extractor, &dense, &matcher, sources))
                .await
                .map_err(|error| RefineError::Transient(error.to_string()))??;
            if considered == candidates.len() {
                break;
            }
            early = rank(&matching.pairs);
            let agreement = agreement(&matching.pairs, &early, same_place(&present));
            if is_clear(&agreement, self.matcher.settings.clear_evidence) {
                break;
            }
        }
        let Matching { pairs, took, .. } = matching;
        let every: Vec<usize> = (0..candidates.len()).collect();
        Ok(Comparison {
            same_place: same_place(&every),
            present_same_place: same_place(&present),
            candidates: candidates.len(),
            considered,
            present,
            order: joined(early, rank(&pairs)),
            pairs,
            took,
        })
    }

    /// Returns where the candidates are in the order of addition and in space, and the number of images of the map.
    async fn places_of(
        &self,
        map: &Map,
        candidates: &[Candidate],
    ) -> Result<(Vec<(Option<usize>, Option<Pose>)>, usize), RefineError> {
        let ids: Vec<ImageId> =
            candidates.iter().map(|candidate| candidate.image_id.clone()).collect();
        let images = self.maps.index_state(map).await?.images;
        let slots = self.maps.slots(map, &ids).await?;
        let poses = candidates.iter().map(|candidate| candidate.pose);
        Ok((slots.into_iter().zip(poses).collect(), images))
    }

    /// Returns the feature source of each candidate, in order; `None` for one that was removed.
    async fn candidate_sources(
        &self,
        map: &Map,
        model: Digest,
        candidates: &[Candidate],
    ) -> Result<Vec<Option<FeatureSource>>, RefineError> {
        let ids: Vec<ImageId> =
            candidates.iter().map(|candidate| candidate.image_id.clone()).collect();
        let images = self.maps.images_by_id(map, &ids).await?;
        let fetches = images.into_iter().map(|image| async move {
            match image {
                Some(image) => self.source(DenseKey { model, picture: image.digest }).await,
                None => Ok(None),
            }
        });
        // Collected first: the compiler cannot prove the lazy iterator `Send`.
        let fetches: Vec<_> = fetches.collect();
        stream::iter(fetches).buffered(CONCURRENT_FETCHES).try_collect().await
    }

    /// Returns a picture's cached features or else its bytes; `None` if the store has no such picture.
    async fn source(&self, key: DenseKey) -> Result<Option<FeatureSource>, RefineError> {
        if let Some(features) = self.dense.get(&key) {
            return Ok(Some(FeatureSource::Cached(features)));
        }
        let bytes = self.blobs.blob(&key.picture).await?;
        Ok(bytes.map(|bytes| FeatureSource::Picture(key, bytes)))
    }
}

/// Converts the error of a missing model. Any version of the map's model would do, because both pictures go
/// through the same one.
fn no_model(error: ModelError) -> RefineError {
    match error {
        ModelError::NotInstalled(_) | ModelError::Broken { .. } => {
            RefineError::Permanent(error.to_string())
        }
        ModelError::AllInUse(_) => RefineError::Transient(error.to_string()),
    }
}

/// The signs in a frame, and what they say about each candidate that is present.
struct Signs<'a> {
    frame: &'a [TextLine],
    of: Vec<SignEvidence>,
}

/// Ranks the compared candidates, and puts removed ones behind them in coarse order.
fn conclude(
    candidates: &[Candidate],
    comparison: &Comparison,
    signs: Option<&Signs<'_>>,
    standing: impl Fn(Option<Evidence>) -> Standing,
) -> Result<Refinement, RefineError> {
    let Comparison { considered, present, pairs, order, took, .. } = comparison;
    let agreement = comparison.agreement();
    let per_pair = u32::try_from(pairs.len()).ok().and_then(|pairs| took.checked_div(pairs));
    let ordered: Vec<usize> = order.iter().map(|&pair| present[pair]).collect();
    let first = order.first().copied();
    let gone = (0..candidates.len()).filter(|index| !present.contains(index));
    let order: Vec<usize> = ordered.iter().copied().chain(gone).collect();
    let ranking = Ranking::new(candidates, &order)
        .map_err(|error| RefineError::Permanent(error.to_string()))?;
    let missing = considered - present.len();
    Ok(Refinement {
        descriptions: present
            .iter()
            .zip(pairs)
            .enumerate()
            .map(|(of, (&index, pair))| Description {
                image_id: candidates[index].image_id.clone(),
                text: match signs {
                    Some(signs) => {
                        let regions = describe(pair, standing(agreement.evidence(of)));
                        format!("{regions}{}", describe_signs(signs.frame, &signs.of[of]))
                    }
                    None => describe(pair, standing(agreement.evidence(of))),
                },
                cached: false,
                stands_in: None,
                took_ms: per_pair.map(milliseconds),
                usage: Usage::default(),
            })
            .collect(),
        reasoning: reasoning(candidates, present, pairs, &ordered, signs),
        reasoning_took_ms: None,
        ordered_by: None,
        evidence: first.and_then(|first| agreement.evidence(first)),
        certainty: None,
        verdicts: Vec::new(),
        agreement: Some(comparison.agreement_of_all()),
        ranking,
        usage: Usage::default(),
        degraded: (missing > 0).then(|| {
            format!("{missing} of {} candidates were removed from the map", candidates.len())
        }),
    })
}

/// Explains in a sentence or two why the first candidate is first.
fn reasoning(
    candidates: &[Candidate],
    present: &[usize],
    pairs: &[PairMatch],
    order: &[usize],
    signs: Option<&Signs<'_>>,
) -> Option<String> {
    let pair_of = |index: usize| present.iter().position(|&known| known == index);
    let votes = |index: usize| Some(pairs.get(pair_of(index)?)?.score * 100.0);
    let first = *order.first()?;
    let id = |index: usize| &candidates[index].image_id;
    let has_most =
        order.iter().all(|&other| votes(other).unwrap_or(0.0) <= votes(first).unwrap_or(0.0));
    let lead = match has_most {
        true => "gets the most of the frame's votes",
        false => "is first because of its signs and the frame's votes",
    };
    let best = format!(
        "{} {lead}: each region of the frame votes for the candidates that match it, and {:.1} % of all votes go to this \
         one",
        id(first),
        votes(first)?
    );
    let votes = match order.get(1) {
        Some(&second) => {
            format!("{best}, {:.1} % to {}, the next best.", votes(second)?, id(second))
        }
        None => format!("{best}."),
    };
    let shared = signs.zip(pair_of(first));
    let shared = shared.map(|(signs, of)| describe_signs(signs.frame, &signs.of[of]));
    Some(votes + &shared.unwrap_or_default())
}
