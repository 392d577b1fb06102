//! Clustered unit vectors, like the descriptors of a town, for benchmarks of search.

use std::ops::Range;

use whereabouts_index::Vectors;

/// Numbers in a vector.
pub const DIM: usize = 384;
const CLUSTERS: usize = 2_000;

/// Vectors, one after another.
pub struct Rows(pub Vec<f32>);

impl Rows {
    pub fn row(&self, index: usize) -> &[f32] {
        &self.0[index * DIM..(index + 1) * DIM]
    }
}

impl Vectors for Rows {
    fn dim(&self) -> usize {
        DIM
    }

    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32])) {
        slots.for_each(|slot| visit(slot, self.row(slot)));
    }
}

/// Unit vectors around common centres.
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
    let mut rows = Vec::with_capacity(count * DIM);
    for index in 0..count {
        let centre = &centres[index % CLUSTERS * DIM..][..DIM];
        let row: Vec<f32> = centre.iter().map(|x| x + 0.35 * random()).collect();
        let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
        rows.extend(row.iter().map(|x| x / norm));
    }
    Rows(rows)
}

/// The share of the true neighbours that was found.
pub fn recall(found: &[Vec<usize>], truth: &[Vec<usize>]) -> f64 {
    let hits = found
        .iter()
        .zip(truth)
        .map(|(found, truth)| found.iter().filter(|slot| truth.contains(slot)).count());
    hits.sum::<usize>() as f64 / (truth.iter().map(Vec::len).sum::<usize>()) as f64
}
