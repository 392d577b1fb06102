//! Builds the graph of a whole map, which is then sealed.
//!
//! The algorithm is HNSW (Malkov and Yashunin, 2018) with these choices:
//!
//! - Equal descriptors are one point with several slots. Otherwise the neighbours of each twin would be its twins, and
//!   the rest of the map would not be reachable from them.
//! - Points are inserted in the order of their highest layer, so that the upper layers are complete before most
//!   points look for their place through them.
//! - The descent through the upper layers is a beam search with [`DESCENT`] points, not a greedy walk: among many
//!   dense clusters, as robots produce that stand still, a greedy walk sometimes ends in the wrong one, and a point
//!   that is linked there is not found again.
//! - A point that meets a full row of neighbours replaces one that it leads to, and is left out if another neighbour
//!   leads to it: the heuristic of algorithm 4. So links out of a cluster survive the many within it.
//! - At the end every point is made reachable, and one that a search does not find is linked where the search ended
//!   ([`Repair`]).
//!
//! A build advances in steps ([`Build`]), so that one map does not keep the indexer from the others.
//!
//! Descriptors are compared by their 8-bit codes, as in the search.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::atomic::AtomicU32;

use parking_lot::Mutex;
use rayon::ThreadPool;
use rayon::prelude::*;

use super::codes::{Codes, Ranked};
use super::layer::Layer;
use super::repair::Repair;
use super::sealed::{DESCENT, SealedGraph, Slots};
use super::{IndexSettings, Vectors};

/// The most layers.
const LAYERS: usize = 16;

/// Points that are linked one after another at first: threads that start together would not see each other's points.
const FIRST: usize = 1000;

/// Locks, each for the rows of many points.
const LOCKS: usize = 1024;

/// A build in progress.
pub(super) enum Build {
    Linking(Builder),
    Repairing(Repair),
    Done(SealedGraph),
}

impl Build {
    /// Starts a graph over the slots that are `live` and stored.
    pub fn new(live: &[bool], vectors: &dyn Vectors, settings: IndexSettings) -> Self {
        Self::Linking(Builder::new(live, vectors, settings))
    }

    /// Links or checks up to `most` points.
    pub fn advance(self, most: usize, threads: &ThreadPool) -> Self {
        match self {
            Self::Linking(mut builder) => {
                let is_linked = builder.link(most, threads);
                if is_linked { Self::Repairing(builder.linked()) } else { Self::Linking(builder) }
            }
            Self::Repairing(mut repair) => {
                let is_complete = repair.advance(most, threads);
                if is_complete { Self::Done(repair.finish()) } else { Self::Repairing(repair) }
            }
            Self::Done(graph) => Self::Done(graph),
        }
    }
}

/// A graph whose points are being linked.
pub(super) struct Builder {
    settings: IndexSettings,
    /// The first slot beyond the graph.
    end: usize,
    slots: Slots,
    codes: Codes,
    /// The lowest first.
    layers: Vec<Layer<AtomicU32>>,
    /// Serialise writes to rows.
    locks: Vec<Mutex<()>>,
    /// Points below this one are linked.
    done: usize,
}

impl Builder {
    fn new(live: &[bool], vectors: &dyn Vectors, settings: IndexSettings) -> Self {
        let (codes, twins) = distinct(live, vectors);
        let mut order: Vec<(usize, u32)> = (0..twins.len() as u32)
            .map(|point| (level(twins[point as usize][0] as usize, settings.m), point))
            .collect();
        order.sort_by_key(|(level, point)| (Reverse(*level), *point));
        let layers = (0..LAYERS)
            .map(|layer| (layer, order.partition_point(|(level, _)| *level >= layer)))
            .take_while(|(layer, points)| *layer == 0 || *points > 0)
            .map(|(layer, points)| {
                let degree = if layer == 0 { 2 * settings.m } else { settings.m };
                Layer::new(points, degree)
            })
            .collect();
        let order: Vec<u32> = order.into_iter().map(|(_, point)| point).collect();
        Self {
            settings,
            end: live.len(),
            slots: Slots::new(order.iter().map(|&point| &twins[point as usize][..])),
            codes: codes.permuted(&order),
            layers,
            locks: (0..LOCKS).map(|_| Mutex::default()).collect(),
            done: 0,
        }
    }

    /// Links up to `most` more points; returns whether all are linked.
    fn link(&mut self, most: usize, threads: &ThreadPool) -> bool {
        let end = self.slots.points().min(self.done + most);
        let alone = self.done..end.min(FIRST).max(self.done);
        let shared = alone.end..end;
        alone.for_each(|point| self.link_one(point as u32));
        threads.install(|| shared.into_par_iter().for_each(|point| self.link_one(point as u32)));
        self.done = end;
        end == self.slots.points()
    }

    /// The graph, once all points are linked.
    fn linked(self) -> Repair {
        let built = (self.settings.m, self.settings.ef_construction);
        let layers = self.layers.into_iter().map(Layer::sealed).collect();
        let graph = SealedGraph::new(built, self.end, self.slots, layers, self.codes);
        Repair::new(graph, self.settings.ef_search)
    }

    fn link_one(&self, point: u32) {
        if point == 0 {
            return;
        }
        let of = self.codes.of(point);
        let mut near = vec![self.codes.ranked(of, 0)];
        let mut links = Vec::new();
        for layer in self.layers.iter().rev() {
            let is_in_it = (point as usize) < layer.points();
            let ef = if is_in_it { self.settings.ef_construction } else { DESCENT };
            near = layer.beam(&self.codes, of, &near, ef, |_| true);
            if is_in_it {
                links.push((layer, self.chosen(&near, layer.degree)));
            }
        }
        // The lowest layer first: a search that reaches this point from above finds it linked below. Until it is
        // linked in a layer, no other thread writes its row there.
        for (layer, links) in links.into_iter().rev() {
            layer.set(point, &links);
            links.into_iter().for_each(|neighbour| self.link_back(layer, neighbour, point));
        }
    }

    /// Makes `new` a neighbour of `point`. If the row is full, `new` is left out if one of the nearer neighbours is
    /// nearer to it than `point` is; else it replaces the farthest of the neighbours that are nearer to `new` than to
    /// `point`, or if there are none, the farthest of all. [`Builder::chosen`] would do the same to the row without
    /// comparing all pairs.
    fn link_back(&self, layer: &Layer<AtomicU32>, point: u32, new: u32) {
        let _writing = self.locks[point as usize % LOCKS].lock();
        let neighbours: Vec<u32> = layer.of(point).collect();
        if neighbours.contains(&new) {
            return;
        }
        if neighbours.len() < layer.degree {
            return layer.put(point, neighbours.len(), new);
        }
        self.codes.prefetch(&neighbours);
        let (to_point, to_new) = (self.codes.of(point), self.codes.of(new));
        let of_new = self.codes.ranked(to_point, new);
        let mut replaced = (false, Reverse(of_new), None);
        for (place, &other) in neighbours.iter().enumerate() {
            let of_other = self.codes.ranked(to_point, other);
            let between = self.codes.ranked(to_new, other);
            if !of_new.is_nearer_than(of_other.min(between)) {
                return;
            }
            let is_crowded = of_new.is_nearer_than(of_other) && between.is_nearer_than(of_other);
            replaced = replaced.max((is_crowded, Reverse(of_other), Some(place)));
        }
        if let (.., Some(place)) = replaced {
            layer.put(point, place, new);
        }
    }

    /// Up to `most` of the points `near` another one, which are given nearest first: those that are nearer to it than
    /// to any chosen before, then the nearest of the rest.
    fn chosen(&self, near: &[Ranked], most: usize) -> Vec<u32> {
        let (mut chosen, mut spare) = (Vec::with_capacity(most), Vec::new());
        for candidate in near {
            if chosen.len() == most {
                break;
            }
            let of = self.codes.of(candidate.point());
            let is_diverse =
                chosen.iter().all(|&other| candidate.is_nearer_than(self.codes.ranked(of, other)));
            if is_diverse { &mut chosen } else { &mut spare }.push(candidate.point());
        }
        spare.truncate(most - chosen.len());
        chosen.append(&mut spare);
        chosen
    }
}

/// The codes of the distinct descriptors among the live slots, and the slots that have each.
fn distinct(live: &[bool], vectors: &dyn Vectors) -> (Codes, Vec<Vec<u32>>) {
    let mut codes = Codes::new(vectors.dim(), 0);
    let mut twins: Vec<Vec<u32>> = Vec::new();
    // Hash → point. Different codes with one hash are rare; the later one takes the next free number.
    let mut known: HashMap<u64, u32> = HashMap::new();
    vectors.scan(0..live.len(), &mut |slot, vector| {
        if !live[slot] {
            return;
        }
        let new = twins.len() as u32;
        codes.push(vector);
        let coded = codes.of(new);
        let mut hash = coded.hash();
        while known.get(&hash).is_some_and(|&point| codes.of(point) != coded) {
            hash = hash.wrapping_add(1);
        }
        match known.entry(hash) {
            Entry::Occupied(twin) => {
                twins[*twin.get() as usize].push(slot as u32);
                codes.pop();
            }
            Entry::Vacant(free) => {
                free.insert(new);
                twins.push(vec![slot as u32]);
            }
        }
    });
    (codes, twins)
}

/// The highest layer of a point: an exponential variate of scale 1 / ln M, rounded down; a function of the slot, so
/// that builds are reproducible.
fn level(slot: usize, m: usize) -> usize {
    // SplitMix64 (Steele, Lea and Flood, 2014).
    let mut z = (slot as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    let uniform = ((z ^ z >> 31) >> 11) as f64 + 0.5;
    let draw = -(uniform / (1_u64 << 53) as f64).ln() / (m.max(2) as f64).ln();
    (draw as usize).min(LAYERS - 1)
}
