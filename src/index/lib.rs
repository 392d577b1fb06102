//! The index of one map: which stored descriptors are most similar to a query's.
//!
//! The index is derived. It reads descriptors from wherever they are stored ([`Vectors`]) by
//! *slot*, the position in which they were stored, and can be thrown away and made again.
//!
//! Small maps are searched exactly. For larger ones an HNSW graph covers the slots below
//! [`MapIndex::graphed`], and the rest, which arrived since, is searched exactly: adding an image
//! never waits for the graph, and a map answers while its graph is still being built. A graph that
//! has caught up is sealed ([`SealedGraph`]), which makes it smaller and its search faster, and lets
//! it be written to a file.

mod exact;
mod graph;
mod sealed;

use std::ops::Range;
use std::sync::Arc;

use parking_lot::{Mutex, MutexGuard, RwLock, RwLockReadGuard, RwLockWriteGuard};
use rayon::ThreadPool;
use rayon::prelude::*;

use self::exact::Best;
use self::graph::Graph;
pub use self::sealed::{DamagedGraph, SealedGraph};
use whereabouts_core::dot;

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
    /// A sealed graph is built again once this share of its points, 0 to 1, has been removed.
    pub max_dead_share: f32,
}

/// A stored descriptor and its similarity to the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScoredSlot {
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
///
/// Slots below [`SealedGraph::end`] are in the sealed graph, those from there to
/// [`MapIndex::graphed`] in the growing one, and the rest in none.
pub struct MapIndex {
    settings: IndexSettings,
    /// Whether the image in each slot is still part of the map.
    live: RwLock<Live>,
    graphs: RwLock<Graphs>,
    /// A graph over everything, on its way to replace those there are. Only the indexer touches it.
    merging: Mutex<Option<Merging>>,
}

#[derive(Default)]
struct Live {
    slots: Vec<bool>,
    count: usize,
    /// Where the sealed graph ends, and how many of the slots below are live.
    sealed_end: usize,
    sealed_count: usize,
}

impl Live {
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
    /// Slots below this one are in one of the two, unless they were removed before they got there.
    graphed: usize,
}

struct Merging {
    graph: Graph,
    /// Slots below this one are in it.
    done: usize,
    /// Slots below this one will be.
    end: usize,
}

impl Graphs {
    /// Where the growing graph begins.
    fn sealed_end(&self) -> usize {
        self.sealed.as_ref().map_or(0, |sealed| sealed.end())
    }
}

impl MapIndex {
    /// An empty index.
    pub fn new(settings: IndexSettings) -> Self {
        Self {
            settings,
            live: RwLock::default(),
            graphs: RwLock::default(),
            merging: Mutex::default(),
        }
    }

    /// Searches with a graph that was sealed by an earlier process.
    pub fn restore(&self, sealed: SealedGraph) {
        self.replace_graphs(Arc::new(sealed));
    }

    /// Makes the image in `slot` part of every later answer.
    pub fn add(&self, slot: usize) {
        self.live_mut().set(slot, true);
    }

    /// Keeps the image in `slot` out of every later answer.
    pub fn remove(&self, slot: usize) {
        self.live_mut().set(slot, false);
    }

    /// How many images are part of the map.
    pub fn len(&self) -> usize {
        self.live().count
    }

    /// Whether no image is part of the map.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Slots below this one are in a graph, unless they were removed before they got there.
    pub fn graphed(&self) -> usize {
        self.graphs().graphed
    }

    /// Bytes of the sealed graph, in memory as on disk. The growing one is not counted.
    pub fn sealed_bytes(&self) -> usize {
        self.graphs().sealed.as_ref().map_or(0, |sealed| sealed.bytes())
    }

    /// The `k` most similar images, best first; equal similarities keep the order of the slots.
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
        let mut best = Best::new(k);
        let mut found_in = |slots: Range<usize>, found: Vec<ScoredSlot>| {
            // Among many removed images a graph can lose its way to the rest.
            let end = slots.end.min(live.slots.len());
            let all = live.slots[slots.start.min(end)..end].iter().filter(|live| **live).take(k);
            if found.len() >= all.count() {
                found.into_iter().for_each(|found| best.offer(found));
            } else {
                exactly(vectors, query, slots, &is_live, &mut best);
            }
        };
        let ef = self.settings.ef_search.max(k);
        if let Some(sealed) = &graphs.sealed {
            found_in(0..sealed_end, sealed.search(vectors, query, (k, ef), is_live));
        }
        if let Some(growing) = &graphs.growing {
            // It may hold more than `graphed` says by now.
            let kept = |slot: usize| slot < graphed && is_live(slot);
            found_in(sealed_end..graphed, growing.search(query, k, ef, &kept));
        }
        exactly(vectors, query, graphed..live.slots.len(), &is_live, &mut best);
        best.into_sorted()
    }

    /// Whether slots wait to be put into a graph.
    pub fn is_behind(&self) -> bool {
        let graphed = self.graphed();
        let live = self.live();
        live.count > self.settings.exact_up_to && graphed < live.slots.len()
    }

    /// Whether [`MapIndex::catch_up`] has anything to do.
    pub fn has_work(&self) -> bool {
        self.is_behind() || self.merging().is_some() || self.wants_sealing()
    }

    /// Whether the growing graph has become as large as the sealed one, or too many points of the
    /// sealed one are dead: a search walks over them in vain.
    fn wants_sealing(&self) -> bool {
        let graphs = self.graphs();
        let (sealed_end, graphed) = (graphs.sealed_end(), graphs.graphed);
        let has_grown = graphs.growing.is_some() && graphed - sealed_end >= sealed_end.max(1);
        let points = graphs.sealed.as_ref().map_or(0, |sealed| sealed.len());
        let dead = points.saturating_sub(self.live().sealed_count);
        has_grown || dead as f32 > self.settings.max_dead_share * points as f32
    }

    /// Does a piece of the work that waits, over at most `most` slots; returns the graph that was
    /// sealed by it, if one was. Call from one thread at a time; searches go on meanwhile.
    ///
    /// New slots go into the growing graph. When none waits and that graph has become as large as
    /// the sealed one, the two are made one, which is then sealed: each slot is put into a graph
    /// twice on average, whatever the size of the map. `threads` share the work on the graph.
    pub fn catch_up(
        &self,
        vectors: &dyn Vectors,
        most: usize,
        threads: &ThreadPool,
    ) -> Option<Arc<SealedGraph>> {
        let mut merging = self.merging();
        if let Some(merge) = merging.as_mut() {
            let end = merge.end.min(merge.done + most);
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
            let end = self.live().slots.len().min(graphs.graphed + most);
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

    /// Replaces the graphs there are by a finished one.
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

    fn live_mut(&self) -> RwLockWriteGuard<'_, Live> {
        self.live.write()
    }

    fn live(&self) -> RwLockReadGuard<'_, Live> {
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

/// Offers every live slot of a range.
fn exactly(
    vectors: &dyn Vectors,
    query: &[f32],
    slots: Range<usize>,
    is_live: &dyn Fn(usize) -> bool,
    best: &mut Best,
) {
    vectors.scan(slots, &mut |slot, vector| {
        if is_live(slot) {
            best.offer(ScoredSlot { slot, similarity: dot(query, vector) });
        }
    });
}

#[cfg(test)]
mod tests;
