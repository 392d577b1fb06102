//! How the cells of two pictures are compared: in integers where the processor can, else in floating point.

use super::LocalError;
#[cfg(target_arch = "x86_64")]
use super::integers::Integers;
use super::mutual::{CellPair, Mutual, mutual};
use super::nearest::Nearest;
use whereabouts_core::dense::DenseFeatures;

/// A query that is compared with one candidate after another.
#[derive(Debug)]
pub(super) enum CellMatcher {
    /// In 16-bit integers.
    #[cfg(target_arch = "x86_64")]
    Integers(Box<Integers>),
    /// In 32-bit floating point, on any processor.
    Floats(Nearest),
}

impl CellMatcher {
    /// Prepares a query. `exact` compares in floating point also where integers would be faster.
    pub fn of(query: &DenseFeatures, exact: bool) -> Self {
        #[cfg(target_arch = "x86_64")]
        if !exact && let Some(integers) = Integers::of(query) {
            return Self::Integers(Box::new(integers));
        }
        let _ = (query, exact);
        Self::Floats(Nearest::default())
    }

    /// Finds the pairs of cells that are each other's nearest neighbour by cosine similarity and more similar than
    /// `min_similarity`. `query` is the one that this was made of.
    ///
    /// A cell is in at most one pair: if several tie for it, as in a repeated pattern, the first gets it.
    pub fn find(
        &mut self,
        query: &DenseFeatures,
        candidate: &DenseFeatures,
        min_similarity: f32,
    ) -> Result<Mutual, LocalError> {
        let channels = query.channels();
        if channels != candidate.channels() {
            return Err(LocalError { query: channels, candidate: candidate.channels() });
        }
        Ok(match self {
            #[cfg(target_arch = "x86_64")]
            Self::Integers(integers) => integers.find(candidate, min_similarity),
            Self::Floats(nearest) => in_floats(query, candidate, min_similarity, nearest),
        })
    }
}

fn in_floats(
    query: &DenseFeatures,
    candidate: &DenseFeatures,
    min_similarity: f32,
    nearest: &mut Nearest,
) -> Mutual {
    let channels = query.channels();
    nearest.find(query.cells(), candidate.cells(), channels);
    for (cell, found) in query.cells().chunks_exact(channels).zip(&mut nearest.of_query) {
        if cell.iter().all(|x| *x == 0.0) {
            found.1 = f32::NEG_INFINITY;
        }
    }
    let pairs = mutual(&nearest.of_query, &nearest.of_candidate)
        .map(|(query, candidate, similarity)| CellPair { query, candidate, similarity })
        .filter(|pair| pair.similarity > min_similarity);
    Mutual {
        pairs: pairs.collect(),
        best: nearest.of_query.iter().map(|(_, similarity)| *similarity).collect(),
    }
}
