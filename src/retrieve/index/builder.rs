//! Builds the graph of a whole map, which is then sealed.
//!
//! The algorithm is that of Malkov and Yashunin (2018), with three choices of its own:
//!
//! - Points come in the order of their highest layer, so that the upper layers are whole before
//!   most points look for their place by them.
//! - The way down through the upper layers is a search with [`DESCENT`] points in view, not with
//!   one: among many dense clusters, as robots leave them that stand still, a greedy walk ends in
//!   the wrong one now and then, and what is linked there is not found again.
//! - Who comes to a full row of neighbours replaces one that it leads to, and is not taken up where
//!   another leads to it: the heuristic of algorithm 4. So links out of a cluster survive the many
//!   within it.
//!
//! Descriptors are compared by their 8-bit codes, as the search compares them.

use std::cmp::Reverse;
use std::sync::atomic::AtomicU32;
use std::sync::{Mutex, PoisonError};

use rayon::ThreadPool;
use rayon::prelude::*;

use super::codes::{Codes, Ranked};
use super::layer::Layer;
use super::sealed::{DESCENT, SealedGraph};
use super::{IndexSettings, Vectors};

/// Layers at the most.
const LAYERS: usize = 16;

/// So many points are linked one after another, before threads share the rest: they would not see
/// each other.
const FIRST: usize = 1000;

/// Locks, each for the rows of many points.
const LOCKS: usize = 1024;

/// A graph that is being built.
pub(super) struct Builder {
    settings: IndexSettings,
    /// Slots from here on are not in it.
    end: usize,
    /// Point → slot.
    slots: Vec<u32>,
    codes: Codes,
    /// The lowest first.
    layers: Vec<Layer<AtomicU32>>,
    /// For changes of rows.
    locks: Vec<Mutex<()>>,
    /// Points below this one are linked.
    done: usize,
}

impl Builder {
    /// Begins a graph over the slots that are `live` and stored.
    pub fn new(live: &[bool], vectors: &dyn Vectors, settings: IndexSettings) -> Self {
        let end = live.len();
        let mut levels: Vec<(usize, usize)> = (0..end)
            .filter(|slot| live[*slot])
            .map(|slot| (level(slot, settings.m), slot))
            .collect();
        levels.sort_by_key(|(level, slot)| (LAYERS - level, *slot));
        let mut codes = Codes::new(vectors.dim(), levels.len());
        let mut stored = Vec::with_capacity(levels.len());
        levels.retain(|(_, slot)| {
            vectors.scan(*slot..slot + 1, &mut |slot, vector| {
                codes.push(vector);
                stored.push(slot as u32);
            });
            stored.last() == Some(&(*slot as u32))
        });
        let layers = (0..LAYERS)
            .map(|layer| (layer, levels.partition_point(|(level, _)| *level >= layer)))
            .take_while(|(layer, points)| *layer == 0 || *points > 0)
            .map(|(layer, points)| {
                let degree = if layer == 0 { 2 * settings.m } else { settings.m };
                Layer::new(points, degree)
            });
        Self {
            settings,
            end,
            slots: stored,
            codes,
            layers: layers.collect(),
            locks: (0..LOCKS).map(|_| Mutex::default()).collect(),
            done: 0,
        }
    }

    /// Links `most` more points; says whether all are.
    pub fn link(&mut self, most: usize, threads: &ThreadPool) -> bool {
        let end = self.slots.len().min(self.done + most);
        let alone = self.done..end.min(FIRST).max(self.done);
        let shared = alone.end..end;
        alone.for_each(|point| self.link_one(point as u32));
        threads.install(|| shared.into_par_iter().for_each(|point| self.link_one(point as u32)));
        self.done = end;
        end == self.slots.len()
    }

    /// The graph, when all are linked.
    pub fn finish(self) -> SealedGraph {
        let layers = self.layers.into_iter().map(Layer::sealed).collect();
        let built = (self.settings.m, self.settings.ef_construction);
        SealedGraph::new(built, self.end, self.slots, layers, self.codes)
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
        // The lowest first: whoever comes to this point from above finds it linked below. Nobody
        // else changes its row in a layer before it is linked there.
        for (layer, links) in links.into_iter().rev() {
            layer.set(point, &links);
            links.into_iter().for_each(|neighbour| self.link_back(layer, neighbour, point));
        }
    }

    /// Makes `new` a neighbour of `point`. Where its row is full somebody has to go: `new`, if it is
    /// nearer to one of the nearer neighbours than to the point; else the farthest of those that are
    /// nearer to `new` than to the point, and if there are none, the farthest of all. That is what
    /// [`Builder::chosen`] would do to a row of its making, without comparing all with all.
    fn link_back(&self, layer: &Layer<AtomicU32>, point: u32, new: u32) {
        let lock = &self.locks[point as usize % LOCKS];
        let _changing = lock.lock().unwrap_or_else(PoisonError::into_inner);
        let neighbours: Vec<u32> = layer.of(point).collect();
        if neighbours.contains(&new) {
            return;
        }
        if neighbours.len() < layer.degree {
            return layer.put(point, neighbours.len(), new);
        }
        self.codes.fetch(&neighbours);
        let (to_point, to_new) = (self.codes.of(point), self.codes.of(new));
        let of_new = self.codes.ranked(to_point, new);
        let mut goes = (false, Reverse(of_new), None);
        for (place, &other) in neighbours.iter().enumerate() {
            let of_other = self.codes.ranked(to_point, other);
            let between = self.codes.ranked(to_new, other);
            if !of_new.is_nearer_than(of_other.min(between)) {
                return;
            }
            let is_crowded = of_new.is_nearer_than(of_other) && between.is_nearer_than(of_other);
            goes = goes.max((is_crowded, Reverse(of_other), Some(place)));
        }
        if let (.., Some(place)) = goes {
            layer.put(point, place, new);
        }
    }

    /// At most `most` of the points `near` another one, given the nearest first: those that are
    /// nearer to it than to any chosen before, then the nearest of the rest.
    fn chosen(&self, near: &[Ranked], most: usize) -> Vec<u32> {
        let (mut chosen, mut spare) = (Vec::with_capacity(most), Vec::new());
        for candidate in near {
            if chosen.len() == most {
                break;
            }
            let of = self.codes.of(candidate.point());
            let stands_alone =
                chosen.iter().all(|&other| candidate.is_nearer_than(self.codes.ranked(of, other)));
            if stands_alone { &mut chosen } else { &mut spare }.push(candidate.point());
        }
        spare.truncate(most - chosen.len());
        chosen.append(&mut spare);
        chosen
    }
}

/// The highest layer of a point: a draw from an exponential distribution of scale 1 / ln M, the same
/// for the same slot.
fn level(slot: usize, m: usize) -> usize {
    // SplitMix64 (Steele, Lea and Flood, 2014).
    let mut z = (slot as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    let uniform = ((z ^ z >> 31) >> 11) as f64 + 0.5;
    let draw = -(uniform / (1_u64 << 53) as f64).ln() / (m.max(2) as f64).ln();
    (draw as usize).min(LAYERS - 1)
}
