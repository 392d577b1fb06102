//! Vectors that the tests of this crate share.

use super::*;

/// Vectors in memory, by slot.
pub struct Rows(pub Vec<Vec<f32>>);

impl Vectors for Rows {
    fn dim(&self) -> usize {
        self.0[0].len()
    }

    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32])) {
        for slot in slots.start..slots.end.min(self.0.len()) {
            visit(slot, &self.0[slot]);
        }
    }
}

/// Settings under which small maps have graphs.
pub const SETTINGS: IndexSettings = IndexSettings {
    exact_up_to: 100,
    m: 16,
    ef_construction: 100,
    ef_search: 64,
    threads: 1,
    max_dead_share: 0.3,
    check_s: 0,
};

/// Two threads.
pub fn threads() -> ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap()
}

/// Unit vectors clustered around a few dozen centres, like the descriptors of one building.
pub fn clustered(count: usize, dim: usize) -> Rows {
    around(32, 0.6, count, dim)
}

/// Unit vectors around common centres.
pub fn around(centres: usize, width: f32, count: usize, dim: usize) -> Rows {
    let mut state = 1_u64;
    let mut random = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    let centres: Vec<Vec<f32>> =
        (0..centres).map(|_| (0..dim).map(|_| random()).collect()).collect();
    let rows = (0..count).map(|i| {
        let row: Vec<f32> =
            centres[i % centres.len()].iter().map(|x| x + width * random()).collect();
        let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
        row.iter().map(|x| x / norm).collect()
    });
    Rows(rows.collect())
}

/// An index of all rows, without a graph yet.
pub fn filled(rows: &Rows) -> MapIndex {
    let index = MapIndex::new(SETTINGS);
    (0..rows.0.len()).for_each(|slot| index.add(slot));
    index
}
