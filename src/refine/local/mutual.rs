//! Mutual nearest neighbours among the cells of two pictures.
//!
//! Positions play no part here; [`agreement`](super::agreement) checks the geometry.

use super::nearest::Nearest;
use super::{LocalError, Match};
use whereabouts_core::dense::DenseFeatures;

/// Two cells that are each other's nearest neighbour, by index into the row-major grids.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CellPair {
    pub query: usize,
    pub candidate: usize,
    pub similarity: f32,
}

/// The mutual nearest neighbours of two pictures.
#[derive(Debug)]
pub(super) struct Mutual {
    /// In the order of the query's cells.
    pub pairs: Vec<CellPair>,
    /// For each query cell, its highest similarity to any cell of the candidate; `NEG_INFINITY` for a cell
    /// that is zero or NaN.
    pub best: Vec<f32>,
}

impl Mutual {
    /// Returns the number of query cells that can be matched.
    pub fn cells(&self) -> usize {
        self.best.iter().filter(|best| best.is_finite()).count()
    }

    /// Returns the pairs with their positions.
    pub fn located(&self, query: &DenseFeatures, candidate: &DenseFeatures) -> Vec<Match> {
        self.pairs
            .iter()
            .map(|pair| Match {
                query: centre(query, pair.query),
                candidate: centre(candidate, pair.candidate),
                similarity: pair.similarity,
            })
            .collect()
    }
}

/// Returns the centre of a cell as `[x, y]` in fractions of the picture.
fn centre(features: &DenseFeatures, cell: usize) -> [f32; 2] {
    let (row, column) = (cell / features.width(), cell % features.width());
    [(column as f32 + 0.5) / features.width() as f32, (row as f32 + 0.5) / features.height() as f32]
}

/// Finds the pairs of cells that are each other's nearest neighbour by cosine similarity and more similar
/// than `min_similarity`.
///
/// A candidate cell is in at most one pair: if several query cells tie for it, as in a repeated pattern,
/// the first gets it.
///
/// `nearest` is working memory, reused from pair to pair.
pub(super) fn find(
    query: &DenseFeatures,
    candidate: &DenseFeatures,
    min_similarity: f32,
    nearest: &mut Nearest,
) -> Result<Mutual, LocalError> {
    let channels = query.channels();
    if channels != candidate.channels() {
        return Err(LocalError { query: channels, candidate: candidate.channels() });
    }
    nearest.find(query.cells(), candidate.cells(), channels);
    for (cell, found) in query.cells().chunks_exact(channels).zip(&mut nearest.of_query) {
        if cell.iter().all(|x| *x == 0.0) {
            found.1 = f32::NEG_INFINITY;
        }
    }
    Ok(keep_mutual(&nearest.of_query, &nearest.of_candidate, min_similarity))
}

/// Two cells are mutual nearest neighbours exactly when their similarity is the highest of both its row and
/// its column.
fn keep_mutual(nearest: &[(usize, f32)], of_candidate: &[f32], min_similarity: f32) -> Mutual {
    let mut assigned = vec![false; of_candidate.len()];
    let mut pairs = Vec::new();
    for (query, (candidate, similarity)) in nearest.iter().copied().enumerate() {
        let mutual = similarity > min_similarity && similarity == of_candidate[candidate];
        if mutual && !assigned[candidate] {
            assigned[candidate] = true;
            pairs.push(CellPair { query, candidate, similarity });
        }
    }
    Mutual { pairs, best: nearest.iter().map(|(_, similarity)| *similarity).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_candidate_cell_is_matched_with_one_query_cell_only() {
        let nearest = [(0, 1.0), (0, 1.0), (1, 0.5)];
        let mutual = keep_mutual(&nearest, &[1.0, 0.8], 0.0);
        assert_eq!(mutual.pairs, [CellPair { query: 0, candidate: 0, similarity: 1.0 }]);
    }
}
