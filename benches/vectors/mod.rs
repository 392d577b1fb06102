//! Sets of unit vectors for benchmarks of search, and how well they are searched.

use std::ops::Range;

use rayon::prelude::*;
use whereabouts_index::Vectors;

/// Numbers in a drawn vector.
pub const DIM: usize = 384;
const CLUSTERS: usize = 2_000;

/// Vectors, one after another.
#[derive(Clone)]
pub struct Rows {
    pub dim: usize,
    pub numbers: Vec<f32>,
}

impl Rows {
    pub fn row(&self, index: usize) -> &[f32] {
        &self.numbers[index * self.dim..(index + 1) * self.dim]
    }

    pub fn len(&self) -> usize {
        self.numbers.len() / self.dim
    }

    /// The rows in this order.
    #[allow(dead_code, reason = "not every benchmark uses it")]
    pub fn reordered(&self, order: impl IntoIterator<Item = usize>) -> Self {
        let numbers = order.into_iter().flat_map(|index| self.row(index).iter().copied()).collect();
        Self { dim: self.dim, numbers }
    }
}

impl Vectors for Rows {
    fn dim(&self) -> usize {
        self.dim
    }

    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32])) {
        slots.for_each(|slot| visit(slot, self.row(slot)));
    }
}

/// Unit vectors around 2,000 common centres, each in turn.
pub fn clustered(count: usize, seed: u64) -> Rows {
    let mut state = seed;
    let mut random = move || {
        // The sum of four uniform numbers is roughly normal.
        (0..4)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
            })
            .sum::<f32>()
    };
    let mut shared = 1_u64;
    let mut centre = || {
        shared = shared.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (shared >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    let centres: Vec<f32> = (0..CLUSTERS * DIM).map(|_| centre()).collect();
    let mut numbers = Vec::with_capacity(count * DIM);
    for index in 0..count {
        let centre = &centres[index % CLUSTERS * DIM..][..DIM];
        let row: Vec<f32> = centre.iter().map(|x| x + 0.35 * random()).collect();
        let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
        numbers.extend(row.iter().map(|x| x / norm));
    }
    Rows { dim: DIM, numbers }
}

/// A map's vectors, and others that are searched for in it.
#[allow(dead_code, reason = "not every benchmark uses it")]
pub struct Set {
    pub name: String,
    pub rows: Rows,
    pub queries: Rows,
}

/// Similarities that differ by less are ties.
const TIE: f32 = 1e-6;
/// Most images of a map that are searched for by their own descriptor.
const SAMPLE: usize = 20_000;

#[allow(dead_code, reason = "not every benchmark uses it")]
impl Set {
    /// The similarity of the tenth best of the `live` rows to each query, by brute force.
    pub fn truth(&self, live: impl IntoIterator<Item = usize>) -> Vec<f32> {
        let live: Vec<usize> = live.into_iter().collect();
        let tenth = |query: usize| {
            let query = self.queries.row(query);
            let mut all: Vec<f32> =
                live.iter().map(|&slot| dot(query, self.rows.row(slot))).collect();
            let tenth = 9.min(all.len() - 1);
            *all.select_nth_unstable_by(tenth, |a, b| b.total_cmp(a)).1
        };
        (0..self.queries.len()).into_par_iter().map(tenth).collect()
    }

    /// The share of ten results that are as similar to their query as its tenth best.
    pub fn recall(&self, found: &[Vec<usize>], tenth_best: &[f32]) -> f64 {
        let right = (0..found.len()).map(|query| {
            let similar = |slot: &&usize| {
                dot(self.queries.row(query), self.rows.row(**slot)) >= tenth_best[query] - TIE
            };
            found[query].iter().filter(similar).count().min(10)
        });
        right.sum::<usize>() as f64 / (10 * found.len()) as f64
    }

    /// Rows that are to find themselves: these, or as many as are measured, spread over them evenly.
    pub fn sample(&self, rows: Vec<usize>) -> Vec<usize> {
        let step = rows.len().div_ceil(SAMPLE).max(1);
        rows.into_iter().step_by(step).collect()
    }

    /// Whether the first result of a search for a row is the row or one equal to it.
    pub fn is_twin(&self, row: usize, found: &[usize]) -> bool {
        found.first().is_some_and(|&first| self.rows.row(first) == self.rows.row(row))
    }
}

#[allow(dead_code, reason = "not every benchmark uses it")]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    whereabouts_core::dot(a, b)
}

/// The share of the true neighbours that was found.
#[allow(dead_code, reason = "not every benchmark uses it")]
pub fn recall(found: &[Vec<usize>], truth: &[Vec<usize>]) -> f64 {
    let hits = found
        .iter()
        .zip(truth)
        .map(|(found, truth)| found.iter().filter(|slot| truth.contains(slot)).count());
    hits.sum::<usize>() as f64 / (truth.iter().map(Vec::len).sum::<usize>()) as f64
}
