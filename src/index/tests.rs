//! Search, sealing and removal on vectors in memory.

use super::*;

struct Rows(Vec<Vec<f32>>);

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

pub(super) const SETTINGS: IndexSettings = IndexSettings {
    exact_up_to: 100,
    m: 16,
    ef_construction: 100,
    ef_search: 64,
    threads: 1,
    max_dead_share: 0.3,
    check_s: 0,
};

fn threads() -> ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap()
}

/// Unit vectors clustered around a few dozen centres, like the descriptors of one building.
fn clustered(count: usize, dim: usize) -> Rows {
    let mut state = 1_u64;
    let mut random = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    let centres: Vec<Vec<f32>> = (0..32).map(|_| (0..dim).map(|_| random()).collect()).collect();
    let rows = (0..count).map(|i| {
        let row: Vec<f32> = centres[i % 32].iter().map(|x| x + 0.6 * random()).collect();
        let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
        row.iter().map(|x| x / norm).collect()
    });
    Rows(rows.collect())
}

fn filled(rows: &Rows) -> MapIndex {
    let index = MapIndex::new(SETTINGS);
    (0..rows.0.len()).for_each(|slot| index.add(slot));
    index
}

#[test]
fn the_graph_finds_what_exact_search_finds() {
    let rows = clustered(1500, 48);
    let index = filled(&rows);
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 200, &threads()).or(sealed);
    }
    assert_eq!(index.graphed(), 1500);
    let sealed = sealed.unwrap();
    assert_eq!((sealed.len(), sealed.end(), sealed.dim()), (1500, 1500, 48));
    let (mut same, mut all) = (0, 0);
    for query in rows.0.iter().step_by(15) {
        let exact = index.search(&rows, query, 10, SearchMode::Exact);
        let fast = index.search(&rows, query, 10, SearchMode::Fast);
        assert_eq!(fast.len(), 10);
        same += exact.iter().filter(|e| fast.iter().any(|f| f.slot == e.slot)).count();
        all += exact.len();
    }
    assert!(same * 100 >= all * 99, "recall@10 is {same}/{all}");
}

#[test]
fn a_sealed_graph_round_trips_and_detects_damage() {
    let rows = clustered(400, 20);
    let index = filled(&rows);
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 100, &threads()).or(sealed);
    }
    let mut bytes = sealed.unwrap().to_bytes();
    let restored = filled(&rows);
    restored.restore(SealedGraph::from_bytes(&bytes).unwrap());
    assert_eq!((restored.graphed(), restored.has_work()), (400, false));
    for query in rows.0.iter().step_by(37) {
        let search = |index: &MapIndex| index.search(&rows, query, 5, SearchMode::Fast);
        assert_eq!(search(&restored), search(&index));
    }
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    assert!(SealedGraph::from_bytes(&bytes).is_err());
    bytes[middle] ^= 1;
    assert!(SealedGraph::from_bytes(&bytes[..bytes.len() - 1]).is_err());
    assert!(SealedGraph::from_bytes(&[]).is_err());
}

#[test]
fn graphs_are_merged_as_a_map_grows_and_every_image_is_found_meanwhile() {
    let rows = clustered(1000, 24);
    let index = MapIndex::new(SETTINGS);
    let mut seals = Vec::new();
    for slot in 0..1000 {
        index.add(slot);
        // Images arrive in bursts, between which the indexer catches up.
        while slot % 100 == 70 && index.has_work() {
            seals.extend(index.catch_up(&rows, 16, &threads()).map(|sealed| sealed.end()));
        }
        if slot % 50 == 0 {
            let found = index.search(&rows, &rows.0[slot], 1, SearchMode::Fast);
            assert_eq!(found[0].slot, slot);
        }
    }
    while index.has_work() {
        seals.extend(index.catch_up(&rows, 16, &threads()).map(|sealed| sealed.end()));
    }
    assert!(seals.len() > 1 && seals.is_sorted(), "{seals:?}");
    assert_eq!(index.graphed(), 1000);
    for slot in (0..1000).step_by(13) {
        let found = index.search(&rows, &rows.0[slot], 1, SearchMode::Fast);
        assert_eq!(found[0].slot, slot);
    }
}

#[test]
fn an_image_is_found_before_it_is_in_the_graph() {
    let rows = clustered(300, 16);
    let index = filled(&rows);
    index.catch_up(&rows, 250, &threads());
    assert_eq!(index.graphed(), 250);
    let found = index.search(&rows, &rows.0[299], 1, SearchMode::Fast);
    assert_eq!(found[0].slot, 299);
}

#[test]
fn a_removed_image_is_never_found() {
    let rows = clustered(300, 16);
    let index = filled(&rows);
    while index.has_work() {
        index.catch_up(&rows, 64, &threads());
    }
    for slot in (0..300).step_by(2) {
        index.remove(slot);
    }
    index.remove(0);
    assert_eq!(index.len(), 150);
    for mode in [SearchMode::Fast, SearchMode::Exact] {
        let found = index.search(&rows, &rows.0[8], 20, mode);
        assert_eq!(found.len(), 20, "{mode:?}");
        assert!(found.iter().all(|found| found.slot % 2 == 1), "{mode:?}");
    }
}

#[test]
fn a_graph_with_too_many_removed_points_is_rebuilt_without_them() {
    let rows = clustered(400, 16);
    let index = filled(&rows);
    let threads = threads();
    let catch_up = || {
        let mut sealed = None;
        while index.has_work() {
            sealed = index.catch_up(&rows, 64, &threads).or(sealed);
        }
        sealed.map(|sealed| sealed.len())
    };
    assert_eq!(catch_up(), Some(400));
    (0..100).for_each(|slot| index.remove(slot));
    assert_eq!(catch_up(), None);
    (100..125).for_each(|slot| index.remove(slot));
    assert_eq!(catch_up(), Some(275));
    let found = index.search(&rows, &rows.0[200], 1, SearchMode::Fast);
    assert_eq!(found[0].slot, 200);
}

#[test]
fn a_small_map_never_builds_a_graph() {
    let rows = clustered(100, 8);
    let index = filled(&rows);
    index.catch_up(&rows, 1000, &threads());
    assert_eq!(index.graphed(), 0);
    assert_eq!(index.search(&rows, &rows.0[3], 500, SearchMode::Fast).len(), 100);
}

#[test]
fn an_empty_map_returns_nothing() {
    let index = MapIndex::new(SETTINGS);
    assert!(index.search(&clustered(1, 8), &[0.0; 8], 10, SearchMode::Fast).is_empty());
}
