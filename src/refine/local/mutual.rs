//! Mutual nearest neighbours: which cells of two pictures choose each other.
//!
//! Knows nothing of where a cell lies; geometry is the business of [`agreement`](super::agreement).

use super::{LocalError, Match};
use crate::domain::dense::DenseFeatures;
use multiversion::multiversion;
use ndarray::{ArrayView2, ArrayViewMut2, linalg::general_mat_mul};

/// Similarities worked out at a time, eight megabytes: all of a pair of usual pictures, so that the
/// candidate is packed once for the product.
const BLOCK: usize = 1 << 21;

/// Running maxima kept side by side, so that the compiler can use vector registers.
const LANES: usize = 16;

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
/// `scratch` has room for similarities, so that not every pair asks for memory of its own.
pub(super) fn find(
    query: &DenseFeatures,
    candidate: &DenseFeatures,
    min_similarity: f32,
    scratch: &mut Vec<f32>,
) -> Result<Mutual, LocalError> {
    let channels = query.channels();
    if channels != candidate.channels() {
        return Err(LocalError::Channels { query: channels, candidate: candidate.channels() });
    }
    let theirs = candidate.len();
    let candidate_cells = ArrayView2::from_shape((theirs, channels), candidate.cells())?;

    let block_rows = (BLOCK / theirs.max(1)).clamp(1, query.len());
    scratch.resize(block_rows * theirs, 0.0);
    let mut nearest = Vec::with_capacity(query.len());
    let mut best_of_column = vec![f32::NEG_INFINITY; theirs];
    for cells in query.cells().chunks(block_rows * channels) {
        let rows = cells.len() / channels;
        let block = &mut scratch[..rows * theirs];
        general_mat_mul(
            1.0,
            &ArrayView2::from_shape((rows, channels), cells)?,
            &candidate_cells.t(),
            0.0,
            &mut ArrayViewMut2::from_shape((rows, theirs), &mut *block)?,
        );
        for (cell, row) in cells.chunks_exact(channels).zip(block.chunks_exact(theirs)) {
            let found = highest(row, &mut best_of_column);
            nearest.push(found.filter(|_| cell.iter().any(|x| *x != 0.0)));
        }
    }
    Ok(keep_mutual(&nearest, &best_of_column, min_similarity))
}

/// A similarity is the same number whichever picture looks at it, so that two cells choose each
/// other exactly when it is the highest of both its row and its column.
fn keep_mutual(
    nearest: &[Option<(usize, f32)>],
    best_of_column: &[f32],
    min_similarity: f32,
) -> Mutual {
    let mut taken = vec![false; best_of_column.len()];
    let mut pairs = Vec::new();
    for (query, choice) in nearest.iter().enumerate() {
        if let Some((candidate, similarity)) = *choice
            && similarity > min_similarity
            && similarity == best_of_column[candidate]
            && !taken[candidate]
        {
            taken[candidate] = true;
            pairs.push(CellPair { query, candidate, similarity });
        }
    }
    let best = nearest.iter().map(|n| n.map_or(f32::NEG_INFINITY, |(_, s)| s)).collect();
    Mutual { pairs, best }
}

/// The larger of two numbers; the second where the first is not a number. Unlike `f32::max` this is
/// one machine instruction.
#[inline(always)]
fn larger(candidate: f32, current: f32) -> f32 {
    if candidate > current { candidate } else { current }
}

/// The first place of the highest number of a row; `None` if it holds no finite number. Raises the
/// maxima of the columns to the row.
fn highest(row: &[f32], best_of_column: &mut [f32]) -> Option<(usize, f32)> {
    let best = raise(row, best_of_column);
    if best.is_finite() { Some((place_of(best, row)?, best)) } else { None }
}

/// Raises the maxima of the columns to a row; gives the highest number of the row.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn raise(row: &[f32], best_of_column: &mut [f32]) -> f32 {
    let mut highest = [f32::NEG_INFINITY; LANES];
    let (chunks, rest) = row.as_chunks::<LANES>();
    let (columns, columns_rest) = best_of_column.as_chunks_mut::<LANES>();
    // Indices, because adapters of iterators are not always compiled into their caller.
    for chunk in 0..chunks.len().min(columns.len()) {
        let (numbers, best) = (&chunks[chunk], &mut columns[chunk]);
        for lane in 0..LANES {
            best[lane] = larger(numbers[lane], best[lane]);
            highest[lane] = larger(numbers[lane], highest[lane]);
        }
    }
    for place in 0..rest.len().min(columns_rest.len()) {
        columns_rest[place] = larger(rest[place], columns_rest[place]);
        highest[place] = larger(rest[place], highest[place]);
    }
    let mut best = f32::NEG_INFINITY;
    for number in highest {
        best = larger(number, best);
    }
    best
}

/// The first place of a number that a row holds.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn place_of(number: f32, row: &[f32]) -> Option<usize> {
    let (chunks, rest) = row.as_chunks::<LANES>();
    for (index, chunk) in chunks.iter().enumerate() {
        // Without stopping early, so that a whole chunk is compared at once.
        let mut held = false;
        for candidate in chunk {
            held |= *candidate == number;
        }
        if held {
            return chunk.iter().position(|x| *x == number).map(|lane| index * LANES + lane);
        }
    }
    rest.iter().position(|x| *x == number).map(|place| chunks.len() * LANES + place)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_number_of_a_row_is_found_in_every_place() {
        for place in 0..37 {
            let mut row = vec![-0.5; 37];
            row[place] = 0.25;
            let mut columns = vec![0.0; 37];
            assert_eq!(highest(&row, &mut columns), Some((place, 0.25)));
            assert_eq!(columns.iter().position(|best| *best == 0.25), Some(place));
            assert_eq!(columns.iter().sum::<f32>(), 0.25);
        }
    }

    #[test]
    fn numbers_that_are_not_numbers_are_never_the_highest() {
        let of = |row: &[f32]| highest(row, &mut vec![-1.0; row.len()]);
        assert_eq!(of(&[f32::NAN, -0.5, f32::NAN]), Some((1, -0.5)));
        assert_eq!(of(&[f32::NAN; 20]), None);
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn a_candidate_cell_is_given_to_one_query_cell_only() {
        let nearest = [Some((0, 1.0)), Some((0, 1.0)), Some((1, 0.5))];
        let mutual = keep_mutual(&nearest, &[1.0, 0.8], 0.0);
        assert_eq!(mutual.pairs, [CellPair { query: 0, candidate: 0, similarity: 1.0 }]);
    }
}
