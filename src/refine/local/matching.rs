//! One query against one group of candidates after another: extracts the features that are missing, and matches.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use whereabouts_core::{DenseFeatures, DescriptorKind};
use whereabouts_vision::{ExtractError, Extractor, FeatureSet};

use super::{Compared, LocalMatcher, PairMatch};
use crate::{DenseCache, DenseKey, RefineError};

/// A picture's dense features, or the bytes to extract them from.
pub(super) enum FeatureSource {
    Cached(Arc<DenseFeatures>),
    Picture(DenseKey, Bytes),
}

/// A query that is compared with one group of candidates after another.
pub(super) struct Matching {
    query: FeatureSource,
    candidates: Vec<Arc<DenseFeatures>>,
    compared: Compared,
    /// How each of the candidates agrees with the query.
    pub pairs: Vec<PairMatch>,
    /// Duration of the matching so far.
    pub took: Duration,
}

impl Matching {
    pub fn of(query: FeatureSource) -> Self {
        let (candidates, pairs) = (Vec::new(), Vec::new());
        Self { query, candidates, compared: Compared::default(), pairs, took: Duration::ZERO }
    }

    /// Extracts missing features, and matches. Blocks.
    pub fn extended(
        mut self,
        extractor: &Extractor,
        dense: &DenseCache,
        matcher: &LocalMatcher,
        candidates: Vec<FeatureSource>,
    ) -> Result<Self, RefineError> {
        let query = features(extractor, dense, self.query)?;
        self.query = FeatureSource::Cached(Arc::clone(&query));
        for candidate in candidates {
            self.candidates.push(features(extractor, dense, candidate)?);
        }
        let candidates: Vec<&DenseFeatures> = self.candidates.iter().map(AsRef::as_ref).collect();
        let began = Instant::now();
        matcher
            .compare_more(&query, &candidates, &mut self.compared)
            .map_err(|error| RefineError::Permanent(error.to_string()))?;
        self.pairs = matcher.judge_all(&query, &candidates, &self.compared);
        self.took += began.elapsed();
        Ok(self)
    }
}

/// The features of a picture, extracted if need be. Blocks.
fn features(
    extractor: &Extractor,
    dense: &DenseCache,
    source: FeatureSource,
) -> Result<Arc<DenseFeatures>, RefineError> {
    match source {
        FeatureSource::Cached(features) => Ok(features),
        FeatureSource::Picture(key, bytes) => {
            let extraction = extractor
                .extract(&bytes, DescriptorKind::GEM, FeatureSet::DescriptorAndDense)
                .map_err(|error: ExtractError| RefineError::Transient(error.to_string()))?;
            let features = extraction.dense.map(Arc::new).ok_or_else(|| {
                RefineError::Permanent("the model computed no dense features".into())
            })?;
            dense.insert(key, Arc::clone(&features));
            Ok(features)
        }
    }
}

/// Joins the order of the first group of candidates with that of all. Unless one of the others is best, the first group
/// keeps its order: the more candidates share the votes of a region, the less these tell apart.
pub(super) fn joined(early: Vec<usize>, all: Vec<usize>) -> Vec<usize> {
    let group = early.len();
    match all.first() {
        Some(&best) if best < group => {
            let others = all.into_iter().filter(|&pair| pair >= group);
            early.into_iter().chain(others).collect()
        }
        _ => all,
    }
}

#[cfg(test)]
mod tests {
    use super::joined;

    #[test]
    fn the_first_candidates_keep_their_order_unless_a_later_one_is_best() {
        assert_eq!(joined(vec![1, 0, 2], vec![0, 4, 1, 3, 2]), [1, 0, 2, 4, 3]);
        assert_eq!(joined(vec![1, 0, 2], vec![4, 0, 1, 3, 2]), [4, 0, 1, 3, 2]);
        assert_eq!(joined(Vec::new(), vec![1, 0]), [1, 0]);
        assert_eq!(joined(Vec::new(), Vec::new()), [0; 0]);
    }
}
