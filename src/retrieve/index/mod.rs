//! The index of one map: which stored descriptors are most similar to a query's.
//!
//! The index is derived. It reads descriptors from wherever they are stored ([`Vectors`]) by
//! *slot*, the position in which they were stored, and can be thrown away and made again.
//!
//! Small maps are searched exactly. For larger ones an HNSW graph covers the slots below
//! [`MapIndex::graphed`], and the rest, which arrived since, is searched exactly: adding an image
//! never waits for the graph, and a map answers while its graph is still being built.

mod exact;
mod graph;

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{OnceLock, PoisonError, RwLock};

use self::exact::Best;
use self::graph::Graph;

/// Stored descriptors, by slot.
pub trait Vectors: Send + Sync {
    /// Numbers in each descriptor.
    fn dim(&self) -> usize;
    /// Calls `visit` with each slot of the range that is stored, in order.
    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32]));
}

/// How a map is indexed.
#[derive(Debug, Clone, Copy)]
pub struct IndexSettings {
    /// Maps with at most this many images are searched exactly, without a graph.
    pub exact_up_to: usize,
    /// Neighbours of a point in the graph (M).
    pub m: usize,
    /// Points looked at when inserting (efConstruction).
    pub ef_construction: usize,
    /// Points looked at when searching (ef); raised to k where that is larger.
    pub ef_search: usize,
}

/// A stored descriptor and its similarity to the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// Where the descriptor is stored.
    pub slot: usize,
    /// Cosine similarity, −1 to 1.
    pub similarity: f32,
}

/// How to search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SearchMode {
    /// The graph where there is one.
    Fast,
    /// Every descriptor: the reference.
    Exact,
}

/// The index of one map.
pub struct MapIndex {
    settings: IndexSettings,
    /// Whether the image in each slot is still part of the map.
    live: RwLock<Live>,
    graph: OnceLock<Graph>,
    graphed: AtomicUsize,
}

#[derive(Default)]
struct Live {
    slots: Vec<bool>,
    count: usize,
}

impl MapIndex {
    /// An empty index.
    pub fn new(settings: IndexSettings) -> Self {
        Self {
            settings,
            live: RwLock::default(),
            graph: OnceLock::new(),
            graphed: AtomicUsize::new(0),
        }
    }

    /// Makes the image in `slot` part of every later answer.
    pub fn add(&self, slot: usize) {
        let mut live = self.live.write().unwrap_or_else(PoisonError::into_inner);
        if live.slots.len() <= slot {
            live.slots.resize(slot + 1, false);
        }
        if !std::mem::replace(&mut live.slots[slot], true) {
            live.count += 1;
        }
    }

    /// Keeps the image in `slot` out of every later answer.
    pub fn remove(&self, slot: usize) {
        let mut live = self.live.write().unwrap_or_else(PoisonError::into_inner);
        if live.slots.get_mut(slot).is_some_and(|live| std::mem::replace(live, false)) {
            live.count -= 1;
        }
    }

    /// How many images are part of the map.
    pub fn len(&self) -> usize {
        self.live.read().unwrap_or_else(PoisonError::into_inner).count
    }

    /// Whether no image is part of the map.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Slots below this one are in the graph, unless they were removed before they got there.
    pub fn graphed(&self) -> usize {
        self.graphed.load(Ordering::Acquire)
    }

    /// The `k` most similar images, best first; equal similarities keep the order of the slots.
    pub fn search(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        k: usize,
        mode: SearchMode,
    ) -> Vec<Found> {
        let live = self.live.read().unwrap_or_else(PoisonError::into_inner);
        let mut best = Best::new(k);
        let is_live = |slot: usize| live.slots.get(slot).copied().unwrap_or(false);
        let graphed = match (mode, self.graph.get()) {
            (SearchMode::Fast, Some(graph)) => {
                let graphed = self.graphed();
                let ef = self.settings.ef_search.max(k);
                let found = graph.search(query, k, ef, &|slot| slot < graphed && is_live(slot));
                // Among many removed images a graph can lose its way to the rest.
                let all = live.slots[..graphed].iter().filter(|live| **live).take(k).count();
                let complete = found.len() >= all;
                found.into_iter().filter(|_| complete).for_each(|found| best.offer(found));
                if complete { graphed } else { 0 }
            }
            _ => 0,
        };
        vectors.scan(graphed..live.slots.len(), &mut |slot, vector| {
            if is_live(slot) {
                best.offer(Found { slot, similarity: exact::dot(query, vector) });
            }
        });
        best.into_sorted()
    }

    /// Whether slots wait to be put into the graph.
    pub fn is_behind(&self) -> bool {
        let live = self.live.read().unwrap_or_else(PoisonError::into_inner);
        live.count > self.settings.exact_up_to && self.graphed() < live.slots.len()
    }

    /// Puts up to `most` waiting slots into the graph. Call from one thread at a time; searches
    /// go on meanwhile.
    pub fn catch_up(&self, vectors: &dyn Vectors, most: usize) {
        if !self.is_behind() {
            return;
        }
        let start = self.graphed();
        let waiting: Vec<bool> = {
            let live = self.live.read().unwrap_or_else(PoisonError::into_inner);
            live.slots[start..].iter().take(most).copied().collect()
        };
        let graph = self.graph.get_or_init(|| Graph::new(&self.settings));
        let end = start + waiting.len();
        vectors.scan(start..end, &mut |slot, vector| {
            if waiting[slot - start] {
                graph.insert(slot, vector);
            }
        });
        self.graphed.store(end, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
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

    const SETTINGS: IndexSettings =
        IndexSettings { exact_up_to: 100, m: 16, ef_construction: 100, ef_search: 64 };

    /// Unit vectors around a few dozen centres, as the descriptors of one building are.
    fn clustered(count: usize, dim: usize) -> Rows {
        let mut state = 1_u64;
        let mut random = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
        };
        let centres: Vec<Vec<f32>> =
            (0..32).map(|_| (0..dim).map(|_| random()).collect()).collect();
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
        while index.is_behind() {
            index.catch_up(&rows, 200);
        }
        assert_eq!(index.graphed(), 1500);
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
    fn an_image_is_found_before_the_graph_has_it() {
        let rows = clustered(300, 16);
        let index = filled(&rows);
        index.catch_up(&rows, 250);
        assert_eq!(index.graphed(), 250);
        let found = index.search(&rows, &rows.0[299], 1, SearchMode::Fast);
        assert_eq!(found[0].slot, 299);
    }

    #[test]
    fn a_removed_image_is_never_found() {
        let rows = clustered(300, 16);
        let index = filled(&rows);
        while index.is_behind() {
            index.catch_up(&rows, 64);
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
    fn a_small_map_never_builds_a_graph() {
        let rows = clustered(100, 8);
        let index = filled(&rows);
        index.catch_up(&rows, 1000);
        assert_eq!(index.graphed(), 0);
        assert_eq!(index.search(&rows, &rows.0[3], 500, SearchMode::Fast).len(), 100);
    }

    #[test]
    fn an_empty_map_finds_nothing() {
        let index = MapIndex::new(SETTINGS);
        assert!(index.search(&clustered(1, 8), &[0.0; 8], 10, SearchMode::Fast).is_empty());
    }
}
