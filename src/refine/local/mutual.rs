//! Mutual nearest neighbours among the cells of two pictures.
//!
//! Positions play no part here; [`agreement`](super::agreement) checks the geometry.

use super::Match;
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

/// The pairs of a row and a column whose similarity is the highest of both, in the order of the rows. `rows` has for each
/// row the column with its highest similarity, `columns` the highest similarity of each column.
pub(super) fn mutual<T: Copy + PartialEq>(
    rows: &[(usize, T)],
    columns: &[T],
) -> impl Iterator<Item = (usize, usize, T)> {
    let mut assigned = vec![false; columns.len()];
    rows.iter().copied().enumerate().filter_map(move |(row, (column, similarity))| {
        let is_new =
            similarity == columns[column] && !std::mem::replace(&mut assigned[column], true);
        is_new.then_some((row, column, similarity))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_column_is_matched_with_one_row_only() {
        let rows = [(0, 1.0), (0, 1.0), (1, 0.5)];
        let found: Vec<_> = mutual(&rows, &[1.0, 0.8]).collect();
        assert_eq!(found, [(0, 0, 1.0)]);
    }
}
