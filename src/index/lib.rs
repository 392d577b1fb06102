//! Nearest-neighbour search over the descriptors of one map.
//!
//! The index is derived data. It reads descriptors from the store ([`Vectors`]) by *slot*, the position at which
//! they were stored, and can be rebuilt from them at any time.
//!
//! Small maps are searched exactly. In larger maps an HNSW graph covers the slots below [`MapIndex::graphed`]; newer
//! slots are searched exactly. Adding an image therefore never waits for the graph, and a map can be searched while
//! its graph is being built. A graph that has caught up is sealed ([`SealedGraph`]): a sealed graph is smaller,
//! faster to search, and can be written to a file.

mod exact;
mod graph;
mod sealed;
mod settings;

use std::ops::Range;
use std::sync::Arc;

use parking_lot::{Mutex, MutexGuard, RwLock, RwLockReadGuard, RwLockWriteGuard};
use rayon::ThreadPool;
use rayon::prelude::*;

use self::exact::TopK;
use self::graph::Graph;
pub use self::sealed::{DamagedGraph, SealedGraph};
pub use self::settings::IndexSettings;
use whereabouts_core::dot;

/// Stored descriptors, by slot.
pub trait Vectors: Send + Sync {
    /// Dimension of the descriptors.
    fn dim(&self) -> usize;
    /// Calls `visit` with every stored slot in the range and its descriptor, in order.
    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32]));
}

/// A search result: a stored descriptor and its similarity to the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScoredSlot {
    /// Slot of the descriptor.
    pub slot: usize,
    /// Cosine similarity, −1 to 1.
    pub similarity: f32,
}

/// The search method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SearchMode {
    /// Approximate search by graph, where there is one.
    Fast,
    /// Exact search over every descriptor; the reference.
    Exact,
}

/// The index of one map.
///
/// Slots below [`SealedGraph::end`] are in the sealed graph, slots from there to [`MapIndex::graphed`] are in the
/// growing graph, and the rest are in none.
pub struct MapIndex {
    settings: IndexSettings,
    /// Which slots hold an image that is part of the map.
    live: RwLock<LiveSlots>,
    graphs: RwLock<Graphs>,
    /// A graph over all slots that will replace both graphs. Used by the indexer only.
    merging: Mutex<Option<Merging>>,
}

#[derive(Default)]
struct LiveSlots {
    slots: Vec<bool>,
    count: usize,
    /// End of the sealed graph.
    sealed_end: usize,
    /// Live slots in the sealed graph.
    sealed_count: usize,
}

impl LiveSlots {
    fn set(&mut self, slot: usize, live: bool) {
        if self.slots.len() <= slot {
            self.slots.resize(slot + 1, false);
        }
        if std::mem::replace(&mut self.slots[slot], live) == live {
            return;
        }
        let step = |count: &mut usize| *count = if live { *count + 1 } else { *count - 1 };
        step(&mut self.count);
        if slot < self.sealed_end {
            step(&mut self.sealed_count);
        }
    }

    fn seal(&mut self, end: usize) {
        self.sealed_end = end;
        self.sealed_count = self.slots.iter().take(end).filter(|live| **live).count();
    }
}

#[derive(Default, Clone)]
struct Graphs {
    sealed: Option<Arc<SealedGraph>>,
    growing: Option<Arc<Graph>>,
    /// Slots below this one are in one of the graphs, unless they were removed before being inserted.
    graphed: usize,
}

struct Merging {
    graph: Graph,
    /// Slots below this one have been inserted.
    done: usize,
    /// Slots below this one are to be inserted.
    end: usize,
}

impl Graphs {
    /// Start of the growing graph.
    fn sealed_end(&self) -> usize {
        self.sealed.as_ref().map_or(0, |sealed| sealed.end())
    }
}

impl MapIndex {
    /// Creates an empty index.
    pub fn new(settings: IndexSettings) -> Self {
        Self {
            settings,
            live: RwLock::default(),
            graphs: RwLock::default(),
            merging: Mutex::default(),
        }
    }

    /// Restores a graph that was sealed by an earlier process.
    pub fn restore(&self, sealed: SealedGraph) {
        self.replace_graphs(Arc::new(sealed));
    }

    /// Includes the image in `slot` in later searches.
    pub fn add(&self, slot: usize) {
        self.live_mut().set(slot, true);
    }

    /// Excludes the image in `slot` from later searches.
    pub fn remove(&self, slot: usize) {
        self.live_mut().set(slot, false);
    }

    /// Number of images in the map.
    pub fn len(&self) -> usize {
        self.live().count
    }

    /// Whether the map has no images.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Slots below this one are in a graph, unless they were removed before being inserted.
    pub fn graphed(&self) -> usize {
        self.graphs().graphed
    }

    /// Size of the sealed graph in bytes, in memory and on disk. The growing graph is not included.
    pub fn sealed_bytes(&self) -> usize {
        self.graphs().sealed.as_ref().map_or(0, |sealed| sealed.bytes())
    }

    /// Returns the `k` most similar images, best first. Ties are ordered by slot.
    pub fn search(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        k: usize,
        mode: SearchMode,
    ) -> Vec<ScoredSlot> {
        let live = self.live();
        let is_live = |slot: usize| live.slots.get(slot).copied().unwrap_or(false);
        let graphs = match mode {
            SearchMode::Fast => self.graphs().clone(),
            SearchMode::Exact => Graphs::default(),
        };
        let (sealed_end, graphed) = (graphs.sealed_end(), graphs.graphed);
        let mut best = TopK::new(k);
        let mut merge = |slots: Range<usize>, found: Vec<ScoredSlot>| {
            // If many images have been removed, a graph search can return too few of the remaining ones.
            let end = slots.end.min(live.slots.len());
            let expected =
                live.slots[slots.start.min(end)..end].iter().filter(|live| **live).take(k);
            if found.len() >= expected.count() {
                found.into_iter().for_each(|found| best.offer(found));
            } else {
                search_exactly(vectors, query, slots, &is_live, &mut best);
            }
        };
        let ef = self.settings.ef_search.max(k);
        if let Some(sealed) = &graphs.sealed {
            merge(0..sealed_end, sealed.search(vectors, query, (k, ef), is_live));
        }
        if let Some(growing) = &graphs.growing {
            // Slots may have been inserted since `graphed` was read.
            let kept = |slot: usize| slot < graphed && is_live(slot);
            merge(sealed_end..graphed, growing.search(query, k, ef, &kept));
        }
        search_exactly(vectors, query, graphed..live.slots.len(), &is_live, &mut best);
        best.into_sorted()
    }

    /// Whether there are slots to be inserted into a graph.
    pub fn is_behind(&self) -> bool {
        let graphed = self.graphed();
        let live = self.live();
        live.count > self.settings.exact_up_to && graphed < live.slots.len()
    }

    /// Whether [`MapIndex::catch_up`] has work to do.
    pub fn has_work(&self) -> bool {
        self.is_behind() || self.merging().is_some() || self.wants_sealing()
    }

    /// Whether the growing graph is as large as the sealed one, or too many points of the sealed graph have
    /// been removed, which slows searches down.
    fn wants_sealing(&self) -> bool {
        let graphs = self.graphs();
        let (sealed_end, graphed) = (graphs.sealed_end(), graphs.graphed);
        let has_grown = graphs.growing.is_some() && graphed - sealed_end >= sealed_end.max(1);
        let points = graphs.sealed.as_ref().map_or(0, |sealed| sealed.len());
        let dead = points.saturating_sub(self.live().sealed_count);
        has_grown || dead as f32 > self.settings.max_dead_share * points as f32
    }

    /// Does one step of the pending work, inserting at most `max_slots` slots on `threads`. Returns the new
    /// sealed graph if the step sealed one. Must be called by one thread at a time; searches run concurrently.
    ///
    /// New slots are inserted into the growing graph. Once it has caught up and is as large as the sealed
    /// graph, both are merged into a new sealed graph. Each slot is inserted twice on average, regardless of
    /// the size of the map.
    pub fn catch_up(
        &self,
        vectors: &dyn Vectors,
        max_slots: usize,
        threads: &ThreadPool,
    ) -> Option<Arc<SealedGraph>> {
        let mut merging = self.merging();
        if let Some(merge) = merging.as_mut() {
            let end = merge.end.min(merge.done + max_slots);
            self.insert(&merge.graph, vectors, merge.done..end, threads);
            merge.done = end;
            if merge.done < merge.end {
                return None;
            }
            let Merging { graph, end, .. } = merging.take()?;
            return Some(self.seal(&graph, end, vectors));
        }
        if self.is_behind() {
            let graphs = self.graphs().clone();
            let growing = graphs.growing.unwrap_or_else(|| Arc::new(Graph::new(&self.settings)));
            let end = self.live().slots.len().min(graphs.graphed + max_slots);
            self.insert(&growing, vectors, graphs.graphed..end, threads);
            let mut graphs = self.graphs_mut();
            graphs.growing = Some(growing);
            graphs.graphed = end;
            return None;
        }
        if !self.wants_sealing() {
            return None;
        }
        let Graphs { sealed, growing, graphed } = self.graphs().clone();
        match (sealed, growing) {
            (None, Some(growing)) => Some(self.seal(&growing, graphed, vectors)),
            _ => {
                let graph = Graph::new(&self.settings);
                *merging = Some(Merging { graph, done: 0, end: graphed });
                None
            }
        }
    }

    fn insert(
        &self,
        graph: &Graph,
        vectors: &dyn Vectors,
        slots: Range<usize>,
        threads: &ThreadPool,
    ) {
        let live: Vec<bool> = {
            let live = self.live();
            slots.clone().map(|slot| live.slots.get(slot).copied().unwrap_or(false)).collect()
        };
        let mut rows = Vec::with_capacity(slots.len());
        vectors.scan(slots.clone(), &mut |slot, vector| {
            if live[slot - slots.start] {
                rows.push((slot, vector.to_vec()));
            }
        });
        threads.install(|| rows.par_iter().for_each(|(slot, vector)| graph.insert(*slot, vector)));
    }

    /// Replaces both graphs by a finished one.
    fn seal(&self, graph: &Graph, end: usize, vectors: &dyn Vectors) -> Arc<SealedGraph> {
        let sealed = Arc::new(SealedGraph::new(&graph.linked(), end, vectors, &self.settings));
        self.replace_graphs(Arc::clone(&sealed));
        sealed
    }

    fn replace_graphs(&self, sealed: Arc<SealedGraph>) {
        let graphed = sealed.end();
        *self.graphs_mut() = Graphs { sealed: Some(sealed), growing: None, graphed };
        self.live_mut().seal(graphed);
    }

    fn live_mut(&self) -> RwLockWriteGuard<'_, LiveSlots> {
        self.live.write()
    }

    fn live(&self) -> RwLockReadGuard<'_, LiveSlots> {
        self.live.read()
    }

    fn graphs(&self) -> RwLockReadGuard<'_, Graphs> {
        self.graphs.read()
    }

    fn graphs_mut(&self) -> RwLockWriteGuard<'_, Graphs> {
        self.graphs.write()
    }

    fn merging(&self) -> MutexGuard<'_, Option<Merging>> {
        self.merging.lock()
    }
}

/// Scores every live slot of the range.
fn search_exactly(
    vectors: &dyn Vectors,
    query: &[f32],
    slots: Range<usize>,
    is_live: &dyn Fn(usize) -> bool,
    best: &mut TopK,
) {
    vectors.scan(slots, &mut |slot, vector| {
        if is_live(slot) {
            best.offer(ScoredSlot { slot, similarity: dot(query, vector) });
        }
    });
}

#[cfg(test)]
mod property_tests;
#[cfg(test)]
mod tests;
