//! The nearest-neighbour index of one map: finds the stored descriptors most similar to that of a query.
//!
//! The index is derived data. It reads descriptors by *slot*, their position in the store ([`Vectors`]), and can be
//! rebuilt at any time.
//!
//! Small maps are searched exactly. For larger ones HNSW graphs cover the slots below [`MapIndex::graphed`]; slots that
//! arrived since are searched exactly, so that adding an image never waits for a graph and a map answers while its
//! graph is being built.
//!
//! There are two graphs: a compact one over the map as it was when it was last sealed ([`SealedGraph`]), which is kept
//! in a file, and one of `hnsw_rs` that grows with every new image. Once the growing one covers as many slots as the
//! sealed one, a new sealed graph is built over all of them (`builder`).

mod beam;
mod builder;
mod codes;
mod exact;
mod graph;
mod layer;
mod repair;
mod sealed;
mod settings;

use std::ops::Range;
use std::sync::Arc;

use parking_lot::{Mutex, RwLock, RwLockReadGuard, RwLockWriteGuard};

use rayon::ThreadPool;
use rayon::prelude::*;

use self::builder::Build;
use self::exact::TopK;
use self::graph::Graph;
pub use self::sealed::{DamagedGraph, SealedGraph};
pub use self::settings::IndexSettings;
use whereabouts_core::dot;

/// A graph over all slots is built in a quarter of the time that `hnsw_rs` takes to insert them one by one.
const FASTER_AS_A_WHOLE: usize = 4;

/// Images that are nearer to one another than this, one minus their similarity, are nearly equal. Frames of a robot that
/// stands still are 0.0002 to 0.004 from one another (`benches/scale`, the set `standing`).
pub const ALIKE: f32 = 0.01;

/// Stored descriptors, by slot.
pub trait Vectors: Send + Sync {
    /// Numbers in each descriptor.
    fn dim(&self) -> usize;
    /// Calls `visit` with each stored slot of the range, in order.
    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32]));
}

/// A stored descriptor and its similarity to the query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScoredSlot {
    /// The slot of the descriptor.
    pub slot: usize,
    /// Cosine similarity, −1 to 1.
    pub similarity: f32,
}

/// Approximate or exact search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SearchMode {
    /// Through the graphs, if there are any.
    Fast,
    /// Every descriptor is compared.
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
    /// The graph that will replace the others. Only the indexer uses it.
    building: Mutex<Option<Build>>,
}

#[derive(Default)]
struct Live {
    slots: Vec<bool>,
    count: usize,
    /// The end of the sealed graph, and the number of live slots below it.
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
    /// Slots below this one are in one of the two graphs, unless they were removed before they were inserted.
    graphed: usize,
}

impl Graphs {
    /// The first slot of the growing graph.
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
            building: Mutex::default(),
        }
    }

    /// Uses a graph that an earlier process sealed.
    pub fn restore(&self, sealed: SealedGraph) {
        self.replace_graphs(Arc::new(sealed));
    }

    /// Adds the image in `slot` to all later results.
    pub fn add(&self, slot: usize) {
        self.add_all([slot]);
    }

    /// Adds the images in these slots to all later results.
    pub fn add_all(&self, slots: impl IntoIterator<Item = usize>) {
        let mut live = self.live_mut();
        slots.into_iter().for_each(|slot| live.set(slot, true));
    }

    /// Removes the image in `slot` from all later results.
    pub fn remove(&self, slot: usize) {
        self.live_mut().set(slot, false);
    }

    /// The number of images in the map.
    pub fn len(&self) -> usize {
        self.live().count
    }

    /// Whether the map has no images.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Slots below this one are in a graph, unless they were removed before they were inserted.
    pub fn graphed(&self) -> usize {
        self.graphs().graphed
    }

    /// Bytes of the sealed graph, in memory and on disk. The growing graph is not counted.
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
        let mut best = TopK::new(k);
        let mut found_in = |slots: Range<usize>, found: Vec<ScoredSlot>| {
            // If many images were removed, a graph search may end before it has found enough live ones.
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
            // It may already hold slots beyond `graphed`.
            let kept = |slot: usize| slot < graphed && is_live(slot);
            found_in(sealed_end..graphed, growing.search(vectors, query, (k, ef), &kept));
        }
        exactly(vectors, query, graphed..live.slots.len(), &is_live, &mut best);
        best.into_sorted()
    }

    /// Whether slots wait to be inserted into a graph.
    pub fn is_behind(&self) -> bool {
        let graphed = self.graphed();
        let live = self.live();
        live.count > self.settings.exact_up_to && graphed < live.slots.len()
    }

    /// Whether [`MapIndex::catch_up`] has work to do.
    pub fn has_work(&self) -> bool {
        // Locked only while the indexer is at work.
        let is_building = || self.building.try_lock().is_none_or(|building| building.is_some());
        let is_due = || self.graphs().growing.as_ref().is_some_and(|growing| growing.is_due());
        self.is_behind() || is_building() || self.wants_sealing() || is_due()
    }

    /// Whether a graph over all slots is to be built: as many slots lie beyond the sealed graph as in it, or so many wait
    /// that they are inserted one by one in no less time, or too many of its slots are dead, which slow down every
    /// search.
    fn wants_sealing(&self) -> bool {
        let Graphs { sealed, graphed, .. } = self.graphs().clone();
        let (end, points) = sealed.map_or((0, 0), |sealed| (sealed.end(), sealed.len()));
        let live = self.live();
        let (beyond, waiting) =
            (live.slots.len().saturating_sub(end), live.slots.len().saturating_sub(graphed));
        let has_grown = live.count > self.settings.exact_up_to
            && (beyond >= end.max(1) || waiting > live.slots.len() / FASTER_AS_A_WHOLE);
        let dead = points.saturating_sub(live.sealed_count);
        has_grown || dead as f32 > self.settings.max_dead_share * points as f32
    }

    /// Processes up to `most` waiting slots; returns the sealed graph, if this completed one. Only one thread may call
    /// it at a time; searches continue meanwhile.
    ///
    /// New slots go into the growing graph, whose images are then searched for again. Once it covers as many slots as the
    /// sealed graph, or many slots arrive at once, a graph over all slots is built, which replaces both: each slot is
    /// inserted into a sealed graph a few times on average, whatever the size of the map. `threads` share the work.
    pub fn catch_up(
        &self,
        vectors: &dyn Vectors,
        most: usize,
        threads: &ThreadPool,
    ) -> Option<Arc<SealedGraph>> {
        let mut building = self.building.lock();
        if let Some(build) = building.take() {
            return match build.advance(most, threads) {
                Build::Done(sealed) => {
                    let sealed = Arc::new(sealed);
                    self.replace_graphs(Arc::clone(&sealed));
                    Some(sealed)
                }
                unfinished => {
                    *building = Some(unfinished);
                    None
                }
            };
        }
        if self.wants_sealing() {
            let live = self.live().slots.clone();
            *building = Some(Build::new(&live, vectors, self.settings));
            return None;
        }
        if self.is_behind() {
            let graphs = self.graphs().clone();
            let growing = graphs.growing.unwrap_or_else(|| Arc::new(Graph::new(&self.settings)));
            let end = self.live().slots.len().min(graphs.graphed + most);
            self.insert(&growing, vectors, graphs.graphed..end, threads);
            growing.check(vectors, most, threads);
            let mut graphs = self.graphs_mut();
            graphs.growing = Some(growing);
            graphs.graphed = end;
        } else if let Some(growing) = self.graphs().growing.clone() {
            growing.check(vectors, most, threads);
        }
        None
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
}

/// Offers every live slot of the range to `best`.
fn exactly(
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
mod test_rows;
#[cfg(test)]
mod tests;
