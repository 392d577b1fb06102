//! The refiner `local`: fetches what the matcher needs, and turns its findings into a ranking.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;

use super::local::{LocalMatcher, Match, PairMatch, describe, rank};
use super::{DenseCache, DenseKey, Progress, RefineError, Refinement, Refiner, milliseconds};
use whereabouts_core::PairRegion;
use whereabouts_core::{
    Candidate, DenseFeatures, Description, DescriptorKind, Digest, Evidence, ImageId, Map, Ranking,
    RefinerKind, Usage,
};
use whereabouts_store::{BlobStore, HardNegatives, JobRecord, MapStore};
use whereabouts_vision::{CpuPool, ExtractError, Extractor, FeatureSet, LoadedModels, ModelError};

/// Geometric matching of dense features, on this machine.
pub struct LocalRefiner {
    /// Where the candidates' records are.
    pub maps: Arc<dyn MapStore>,
    /// Where their bytes are.
    pub blobs: Arc<dyn BlobStore>,
    /// The models that make dense features which the cache has lost.
    pub models: LoadedModels,
    /// Dense features.
    pub dense: Arc<DenseCache>,
    /// Where matching runs.
    pub pool: CpuPool,
    /// Compares.
    pub matcher: LocalMatcher,
}

/// A picture whose dense features are known, or whose bytes are.
enum Source {
    Dense(Arc<DenseFeatures>),
    Bytes(DenseKey, Bytes),
}

#[async_trait]
impl Refiner for LocalRefiner {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Local
    }

    async fn refine(
        &self,
        record: &JobRecord,
        _: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let compared = self.compared_of(record).await?;
        conclude(&record.candidates, &compared)
    }

    async fn regions(
        &self,
        record: &JobRecord,
        image: &ImageId,
    ) -> Result<Option<Vec<PairRegion>>, RefineError> {
        // Beside the others, as it was compared: what speaks for it depends on them.
        let Compared { present, pairs, .. } = self.compared_of(record).await?;
        let of = present.iter().position(|&index| record.candidates[index].image_id == *image);
        let matches = of.and_then(|of| pairs.into_iter().nth(of)).map(|pair| pair.matches);
        let region = |found: Match| PairRegion {
            frame: found.query,
            image: found.candidate,
            similarity: found.similarity,
        };
        Ok(matches.map(|matches| matches.into_iter().map(region).collect()))
    }

    async fn chance(
        &self,
        map: &Map,
        asked: &HardNegatives,
    ) -> Result<Option<Evidence>, RefineError> {
        let extractor = self.models.of(map).await.map_err(no_model)?;
        let query = match self.maps.image(map, &asked.image_id).await? {
            Some(image) => {
                self.source(DenseKey { model: extractor.identity(), picture: image.digest }).await?
            }
            None => None,
        };
        let Some(query) = query else { return Ok(None) };
        let Compared { pairs, .. } = self.compared(map, extractor, query, &asked.others).await?;
        Ok(rank(&pairs).first().and_then(|&first| agreement(&pairs, first)))
    }
}

/// Candidates that could be compared, and how.
struct Compared {
    /// Their places among the candidates.
    present: Vec<usize>,
    /// What they have in common with the query.
    pairs: Vec<PairMatch>,
    /// How long comparing them took, without getting their features.
    took: Duration,
}

impl LocalRefiner {
    /// The frame of a job with its candidates.
    async fn compared_of(&self, record: &JobRecord) -> Result<Compared, RefineError> {
        let map = match self.maps.map(&record.job.map).await? {
            Some(map) if map.uid == record.map_uid => map,
            _ => return Err(RefineError::Permanent("the map was removed".into())),
        };
        let extractor = self.models.of(&map).await.map_err(no_model)?;
        let model = extractor.identity();
        let query = self
            .source(DenseKey { model, picture: record.query.digest })
            .await?
            .ok_or_else(|| RefineError::Permanent("the frame is missing from the store".into()))?;
        self.compared(&map, extractor, query, &record.candidates).await
    }

    async fn compared(
        &self,
        map: &Map,
        extractor: Arc<Extractor>,
        query: Source,
        candidates: &[Candidate],
    ) -> Result<Compared, RefineError> {
        let model = extractor.identity();
        let mut present = Vec::new();
        let mut sources = Vec::new();
        for (index, candidate) in candidates.iter().enumerate() {
            if let Some(source) = self.candidate_source(map, model, candidate).await? {
                present.push(index);
                sources.push(source);
            }
        }
        let (dense, matcher) = (Arc::clone(&self.dense), self.matcher.clone());
        let (pairs, took) = self
            .pool
            .run(move || compare(&extractor, &dense, &matcher, query, sources))
            .await
            .map_err(|error| RefineError::Transient(error.to_string()))??;
        Ok(Compared { present, pairs, took })
    }

    async fn candidate_source(
        &self,
        map: &Map,
        model: Digest,
        candidate: &Candidate,
    ) -> Result<Option<Source>, RefineError> {
        match self.maps.image(map, &candidate.image_id).await? {
            Some(image) => self.source(DenseKey { model, picture: image.digest }).await,
            None => Ok(None),
        }
    }

    async fn source(&self, key: DenseKey) -> Result<Option<Source>, RefineError> {
        if let Some(features) = self.dense.get(&key) {
            return Ok(Some(Source::Dense(features)));
        }
        let bytes = self.blobs.blob(&key.picture).await?;
        Ok(bytes.map(|bytes| Source::Bytes(key, bytes)))
    }
}

/// Any version of the map's model will do: both pictures are looked at with the same one.
fn no_model(error: ModelError) -> RefineError {
    match error {
        ModelError::NotInstalled(_) | ModelError::Broken { .. } => {
            RefineError::Permanent(error.to_string())
        }
        ModelError::AllInUse(_) => RefineError::Transient(error.to_string()),
    }
}

/// Extracts what is missing and compares, and says how long the comparison took; blocks.
fn compare(
    extractor: &Extractor,
    dense: &DenseCache,
    matcher: &LocalMatcher,
    query: Source,
    candidates: Vec<Source>,
) -> Result<(Vec<PairMatch>, Duration), RefineError> {
    let features = |source: Source| match source {
        Source::Dense(features) => Ok(features),
        Source::Bytes(key, bytes) => {
            let extraction = extractor
                .extract(&bytes, DescriptorKind::Gem, FeatureSet::DescriptorAndDense)
                .map_err(|error: ExtractError| RefineError::Transient(error.to_string()))?;
            let features = extraction.dense.map(Arc::new).ok_or_else(|| {
                RefineError::Permanent("the model computed no dense features".into())
            })?;
            dense.insert(key, Arc::clone(&features));
            Ok(features)
        }
    };
    let query = features(query)?;
    let candidates =
        candidates.into_iter().map(features).collect::<Result<Vec<_>, RefineError>>()?;
    let candidates: Vec<&DenseFeatures> = candidates.iter().map(AsRef::as_ref).collect();
    let began = Instant::now();
    let pairs = matcher
        .compare_all(&query, &candidates)
        .map_err(|error| RefineError::Permanent(error.to_string()))?;
    Ok((pairs, began.elapsed()))
}

/// Orders those that could be compared, and puts those that are gone behind them.
fn conclude(candidates: &[Candidate], compared: &Compared) -> Result<Refinement, RefineError> {
    let Compared { present, pairs, took } = compared;
    let share = u32::try_from(pairs.len()).ok().and_then(|pairs| took.checked_div(pairs));
    let places = rank(pairs);
    let ordered: Vec<usize> = places.iter().map(|&place| present[place]).collect();
    let gone = (0..candidates.len()).filter(|index| !present.contains(index));
    let order: Vec<usize> = ordered.iter().copied().chain(gone).collect();
    let ranking = Ranking::new(candidates, &order)
        .map_err(|error| RefineError::Permanent(error.to_string()))?;
    let missing = candidates.len() - present.len();
    Ok(Refinement {
        descriptions: present
            .iter()
            .zip(pairs)
            .map(|(&index, pair)| Description {
                image_id: candidates[index].image_id.clone(),
                text: describe(pair),
                cached: false,
                stands_in: None,
                took_ms: share.map(milliseconds),
                usage: Usage::default(),
            })
            .collect(),
        reasoning: reasoning(candidates, present, pairs, &ordered),
        reasoning_took_ms: None,
        evidence: places.first().and_then(|&first| agreement(pairs, first)),
        ranking,
        usage: Usage::default(),
        degraded: (missing > 0).then(|| {
            format!("{missing} of {} candidates were removed from the map", candidates.len())
        }),
    })
}

/// What speaks for one of the candidates that were compared.
fn agreement(pairs: &[PairMatch], of: usize) -> Option<Evidence> {
    let agreeing: Vec<usize> = pairs.iter().map(|pair| pair.matches.len()).collect();
    Evidence::agreement(&agreeing, of)
}

/// One sentence on why the first is the first.
fn reasoning(
    candidates: &[Candidate],
    present: &[usize],
    pairs: &[PairMatch],
    order: &[usize],
) -> Option<String> {
    let score = |index: usize| {
        let place = present.iter().position(|&known| known == index)?;
        pairs.get(place).map(|pair| pair.score * 100.0)
    };
    let first = *order.first()?;
    let best = format!(
        "{} shares the most with the frame: {:.1} % of the frame's regions speak for it",
        candidates[first].image_id,
        score(first)?
    );
    Some(match order.get(1) {
        Some(&second) => format!(
            "{best}, against {:.1} % for {}, the next best.",
            score(second)?,
            candidates[second].image_id
        ),
        None => format!("{best}."),
    })
}
