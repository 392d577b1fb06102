//! Properties of an index under random additions, removals, background work and restarts.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::test_rows::Rows;
use super::*;

/// A step in the life of an index. Numbers are taken modulo what exists.
#[derive(Debug, Clone)]
enum Step {
    /// Adds images in the next slots.
    Add(usize),
    /// Removes an image.
    Remove(usize),
    /// Removes consecutive images.
    RemoveRange(usize, usize),
    /// Inserts up to a number of slots into a graph, or seals it.
    CatchUp(usize),
    /// Catches up completely.
    Settle,
    /// Replaces the index with a new one that restores the last sealed graph from its bytes.
    Restart,
}

const MAX_SLOTS: usize = 240;

const SETTINGS: IndexSettings = IndexSettings {
    exact_up_to: 20,
    m: 8,
    ef_construction: 64,
    // At least as many as there are slots, so that the graph has no excuse for missing one.
    ef_search: MAX_SLOTS,
    max_dead_share: 0.3,
    threads: 0,
    check_s: 0,
};

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        4 => (1..40_usize).prop_map(Step::Add),
        3 => any::<usize>().prop_map(Step::Remove),
        1 => (any::<usize>(), 1..40_usize).prop_map(|(at, count)| Step::RemoveRange(at, count)),
        4 => (1..50_usize).prop_map(Step::CatchUp),
        2 => Just(Step::Settle),
        1 => Just(Step::Restart),
    ];
    proptest::collection::vec(step, 1..40)
}

/// A unit vector for each slot; every fifth repeats an earlier one, so that similarities tie.
fn rows(seed: u64) -> Rows {
    let mut state = seed | 1;
    let mut random = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    let mut rows: Vec<Vec<f32>> = Vec::new();
    for slot in 0..MAX_SLOTS {
        let row: Vec<f32> = (0..8).map(|_| random()).collect();
        let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-6);
        rows.push(match slot % 5 {
            4 => rows[slot / 2].clone(),
            _ => row.iter().map(|x| x / norm).collect(),
        });
    }
    Rows(rows)
}

/// The index under test, and what it should contain.
struct Model<'a> {
    rows: &'a Rows,
    threads: &'a ThreadPool,
    index: MapIndex,
    live: BTreeSet<usize>,
    next_slot: usize,
    /// The bytes of the last graph that was sealed.
    sealed: Option<Vec<u8>>,
}

impl Model<'_> {
    fn apply(&mut self, step: &Step) {
        match *step {
            Step::Add(count) => {
                for slot in self.next_slot..MAX_SLOTS.min(self.next_slot + count) {
                    self.index.add(slot);
                    self.live.insert(slot);
                    self.next_slot = slot + 1;
                }
            }
            Step::Remove(at) => self.remove(at, 1),
            Step::RemoveRange(at, count) => self.remove(at, count),
            Step::CatchUp(most) => self.catch_up(most),
            Step::Settle => {
                while self.index.has_work() {
                    self.catch_up(64);
                }
                assert!(!self.index.is_behind());
            }
            Step::Restart => self.restart(),
        }
    }

    fn remove(&mut self, at: usize, count: usize) {
        if self.next_slot == 0 {
            return;
        }
        let first = at % self.next_slot;
        for slot in first..self.next_slot.min(first + count) {
            self.index.remove(slot);
            self.live.remove(&slot);
        }
    }

    fn catch_up(&mut self, most: usize) {
        if let Some(sealed) = self.index.catch_up(self.rows, most, self.threads) {
            self.sealed = Some(sealed.to_bytes());
        }
    }

    fn restart(&mut self) {
        self.index = MapIndex::new(SETTINGS);
        if let Some(bytes) = &self.sealed {
            self.index.restore(SealedGraph::from_bytes(bytes).unwrap());
        }
        self.live.iter().for_each(|slot| self.index.add(*slot));
    }

    /// The most similar live slots by brute force; ties keep the order of the slots.
    fn expected(&self, query: &[f32], k: usize) -> Vec<usize> {
        let mut all: Vec<(usize, f32)> =
            self.live.iter().map(|slot| (*slot, dot(query, &self.rows.0[*slot]))).collect();
        all.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        all.into_iter().take(k).map(|(slot, _)| slot).collect()
    }

    /// Checks both search modes for one query. Returns how many of the nearest slots the fast search
    /// found, and how many there are.
    fn check(&self, query: &[f32], k: usize) -> Result<(usize, usize), TestCaseError> {
        prop_assert_eq!(self.index.len(), self.live.len());
        let expected = self.expected(query, k);
        let search = |mode| self.index.search(self.rows, query, k, mode);
        let exact: Vec<usize> = search(SearchMode::Exact).iter().map(|found| found.slot).collect();
        prop_assert_eq!(&exact, &expected);
        let fast = search(SearchMode::Fast);
        prop_assert_eq!(fast.len(), expected.len());
        prop_assert!(fast.iter().all(|found| self.live.contains(&found.slot)));
        let distinct: BTreeSet<usize> = fast.iter().map(|found| found.slot).collect();
        prop_assert_eq!(distinct.len(), fast.len());
        for found in &fast {
            let similarity = dot(query, &self.rows.0[found.slot]);
            prop_assert!((found.similarity - similarity).abs() < 1e-5);
        }
        prop_assert!(fast.is_sorted_by(|a, b| a.similarity >= b.similarity - 1e-6));
        // Slots with the same descriptor are equally good answers.
        let worst = expected.last().map_or(f32::MIN, |slot| dot(query, &self.rows.0[*slot]));
        let right = fast.iter().filter(|found| found.similarity >= worst - 1e-6).count();
        Ok((right, expected.len()))
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 96,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn an_index_agrees_with_brute_force_after_any_additions_removals_seals_and_restarts(
        seed in any::<u64>(),
        steps in steps(),
        k in 1..12_usize,
    ) {
        let rows = rows(seed);
        let threads = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let mut model = Model {
            rows: &rows,
            threads: &threads,
            index: MapIndex::new(SETTINGS),
            live: BTreeSet::new(),
            next_slot: 0,
            sealed: None,
        };
        let (mut right, mut all) = (0, 0);
        for (number, step) in steps.iter().enumerate() {
            model.apply(step);
            let (found, expected) = model.check(&rows.0[number * 7 % MAX_SLOTS], k)?;
            right += found;
            all += expected;
        }
        // The fast search may miss few neighbours: 98 of 100 must be found.
        prop_assert!(right * 100 >= all * 98 || all - right <= 2, "recall is {right}/{all}");
    }
}
