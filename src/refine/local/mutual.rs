//! Mutual nearest neighbours: which cells of two pictures choose each other.
//!
//! Knows nothing of where a cell lies; geometry is the business of [`agreement`](super::agreement).

use super::nearest::Nearest;
use super::{LocalError, Match};
use whereabouts_core::dense::DenseFeatures;

/// Two cells that choose each other, by index into the row-major grids.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CellPair {
    pub query: usize,
    pub candidate: usize,
    pub similarity: f32,
}

/// What the similarities of two pictures have to say.
#[derive(Debug)]
pub(super) struct Mutual {
    /// In the order of the query's cells.
    pub pairs: Vec<CellPair>,
    /// For each query cell, its highest similarity to any cell of the candidate; `NEG_INFINITY` for
    /// a cell that is zero or not a number.
    pub best: Vec<f32>,
}

impl Mutual {
    /// Query cells that took part.
    pub fn cells(&self) -> usize {
        self.best.iter().filter(|best| best.is_finite()).count()
    }

    /// The pairs with their positions.
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

/// The centre of a cell in fractions of the picture, `[x, y]`.
fn centre(features: &DenseFeatures, cell: usize) -> [f32; 2] {
    let (row, column) = (cell / features.width(), cell % features.width());
    [(column as f32 + 0.5) / features.width() as f32, (row as f32 + 0.5) / features.height() as f32]
}

/// Finds the pairs of cells that are each other's nearest neighbour by cosine similarity and more
/// alike than `min_similarity`.
///
/// A candidate cell is given away once: where several query cells tie for it, as in a repeated
/// pattern, the first has it.
///
/// `nearest` is memory to work in, so that not every pair asks for its own.
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

/// A similarity is the same number whichever picture looks at it, so that two cells choose each
/// other exactly when it is the highest of both its row and its column.
fn keep_mutual(nearest: &[(usize, f32)], of_candidate: &[f32], min_similarity: f32) -> Mutual {
    let mut taken = vec![false; of_candidate.len()];
    let mut pairs = Vec::new();
    for (query, (candidate, similarity)) in nearest.iter().copied().enumerate() {
        let chosen = similarity > min_similarity && similarity == of_candidate[candidate];
        if chosen && !taken[candidate] {
            taken[candidate] = true;
            pairs.push(CellPair { query, candidate, similarity });
        }
    }
    Mutual { pairs, best: nearest.iter().map(|(_, similarity)| *similarity).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_candidate_cell_is_given_to_one_query_cell_only() {
        let nearest = [(0, 1.0), (0, 1.0), (1, 0.5)];
        let mutual = keep_mutual(&nearest, &[1.0, 0.8], 0.0);
        assert_eq!(mutual.pairs, [CellPair { query: 0, candidate: 0, similarity: 1.0 }]);
    }
}
