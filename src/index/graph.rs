//! The graph that takes new images until the next sealing: HNSW (Malkov and Yashunin, 2018) of `hnsw_rs`, which is
//! searched while it grows.
//!
//! Images with equal or nearly equal descriptors, within [`ALIKE`] of a point, are one point with several slots: the
//! neighbours of each of many would be one another, and the rest of the map could not be reached from them.
//!
//! `hnsw_rs` does not promise that a point is found, and a new point can cost an earlier one its last link. Images are
//! therefore searched for after they were inserted, after another was inserted near them, and again before the graph is
//! at rest; the points of those that are missed are *stray* and are compared with every query.

use std::collections::{BTreeSet, HashMap};
use std::hash::{BuildHasher, RandomState};
use std::sync::atomic::{AtomicUsize, Ordering};

use hnsw_rs::prelude::{Distance, Hnsw, Neighbour};
use parking_lot::{Mutex, RwLock};
use rayon::ThreadPool;
use rayon::prelude::*;

use super::sealed::WIDENINGS;
use super::{ALIKE, IndexSettings, ScoredSlot, Vectors};
use whereabouts_core::dot;

/// One minus the dot product of unit vectors.
///
/// The crate's own `DistDot` panics on a dot product slightly above 1, which rounding produces.
#[derive(Clone, Copy, Default)]
struct CosineDistance;

impl Distance<f32> for CosineDistance {
    fn eval(&self, a: &[f32], b: &[f32]) -> f32 {
        (1.0 - dot(a, b)).max(0.0)
    }
}

/// A distance that is zero but for rounding.
const SAME: f32 = 1e-6;

/// Points near a new one that may lose links to it.
const NEAR: usize = 32;

/// Points examined to find those near a new one.
const EF_NEAR: usize = 48;

/// Images that are searched for again because a point was inserted: all of them in a graph that is smaller, or after as
/// large a share of it was inserted.
const AGAIN: usize = 256;

pub(super) struct Graph {
    hnsw: Hnsw<'static, f32, CosineDistance>,
    points: RwLock<Points>,
    hasher: RandomState,
    /// Points that a search for the descriptor of one of their slots misses.
    stray: RwLock<BTreeSet<usize>>,
    /// Points near those that were inserted since they were searched for last.
    suspects: Mutex<BTreeSet<usize>>,
    /// As many of the inserted images were searched for at least once.
    checked: AtomicUsize,
    /// The next image to be searched for again.
    again: AtomicUsize,
    /// As many images are searched for again before the graph is at rest.
    due: AtomicUsize,
    ef: usize,
}

/// The points of a graph and their slots.
#[derive(Default)]
struct Points {
    /// Point → the slots of each of its descriptors, ascending. The first descriptor is that of the point.
    slots: Vec<Vec<Vec<usize>>>,
    /// Slot and point of each image, but for those that are equal to another, in the order of insertion.
    inserted: Vec<(usize, usize)>,
    /// Hash of a descriptor → its point and its place in the point. The hash has 64 bits and a random key, so that two
    /// descriptors of one map hardly ever share it.
    by_hash: HashMap<u64, (usize, usize)>,
}

impl Graph {
    pub fn new(settings: &IndexSettings) -> Self {
        // The number of elements is a hint for the first allocation, not a bound.
        const EXPECTED: usize = 16_384;
        const LAYERS: usize = 16;
        let hnsw =
            Hnsw::new(settings.m, EXPECTED, LAYERS, settings.ef_construction, CosineDistance);
        Self {
            hnsw,
            points: RwLock::default(),
            hasher: RandomState::new(),
            stray: RwLock::default(),
            suspects: Mutex::default(),
            checked: AtomicUsize::new(0),
            again: AtomicUsize::new(0),
            due: AtomicUsize::new(0),
            ef: settings.ef_search,
        }
    }

    pub fn insert(&self, slot: usize, vector: &[f32]) {
        let bytes: &[u8] = bytemuck::cast_slice(vector);
        let hash = self.hasher.hash_one(bytes);
        let near = self.hnsw.search(vector, NEAR, EF_NEAR);
        let alike = near.first().filter(|nearest| nearest.distance < ALIKE);
        let point = {
            let mut points = self.points.write();
            if let Some(&(point, place)) = points.by_hash.get(&hash) {
                let equal = &mut points.slots[point][place];
                // Several threads insert, and of equal images the first ones are results.
                let at = equal.partition_point(|other| *other < slot);
                equal.insert(at, slot);
                return;
            }
            let joined = alike.map(|nearest| nearest.d_id);
            let point = joined.unwrap_or(points.slots.len());
            if joined.is_none() {
                points.slots.push(Vec::new());
            }
            let place = points.slots[point].len();
            points.slots[point].push(vec![slot]);
            points.inserted.push((slot, point));
            points.by_hash.insert(hash, (point, place));
            if joined.is_some() {
                return;
            }
            let due = self.due.load(Ordering::Relaxed) + AGAIN;
            self.due.store(due.min(points.inserted.len()), Ordering::Relaxed);
            point
        };
        self.hnsw.insert((vector, point));
        self.suspects.lock().extend(near.iter().map(|neighbour| neighbour.d_id));
    }

    /// Whether images are to be searched for again.
    pub fn is_due(&self) -> bool {
        self.due.load(Ordering::Relaxed) > 0
    }

    /// Searches for the images that were inserted since the last call, and for up to `most` of the others that are due,
    /// in turn; notes the points of those that are missed. Only one thread may call it at a time, and none may insert
    /// meanwhile.
    pub fn check(&self, vectors: &dyn Vectors, most: usize, threads: &ThreadPool) {
        let points = self.points.read();
        let end = points.inserted.len();
        let old = self.checked.swap(end, Ordering::Relaxed);
        let from = Some(self.again.load(Ordering::Relaxed)).filter(|from| *from < old).unwrap_or(0);
        let due = self.due.load(Ordering::Relaxed);
        let to = old.min(from + most.min(due));
        self.again.store(to, Ordering::Relaxed);
        self.due.store(due.saturating_sub(to - from), Ordering::Relaxed);
        let is_missed = |slot: usize, point: usize| {
            let mut missed = false;
            // A slot whose row is gone cannot be searched for; another of the same point can.
            for &slot in std::iter::once(&slot).chain(points.slots[point].iter().flatten()) {
                let mut stored = false;
                vectors.scan(slot..slot + 1, &mut |_, vector| {
                    let found = self.hnsw.search(vector, self.ef, self.ef);
                    let is_it = |near: &Neighbour| near.d_id == point || near.distance <= SAME;
                    missed = !found.iter().any(is_it);
                    stored = true;
                });
                if stored {
                    break;
                }
            }
            missed
        };
        let suspects = std::mem::take(&mut *self.suspects.lock()).into_iter();
        let suspects: Vec<_> = suspects.map(|point| (points.slots[point][0][0], point)).collect();
        let due: Vec<(usize, usize)> =
            [&points.inserted[from..to], &points.inserted[old..end], &suspects].concat();
        let missed = due.into_par_iter().filter(|&(slot, point)| is_missed(slot, point));
        let missed: Vec<usize> = threads.install(|| missed.map(|(_, point)| point).collect());
        self.stray.write().extend(missed);
    }

    /// The slots of the nearest points and of the stray ones that `keep` accepts. There may be fewer than `k` although more are accepted, if
    /// most of the nearest are not.
    ///
    /// The filter is applied to the results: `hnsw_rs` itself does not stop early when it is given one, and takes
    /// about ten times as long.
    pub fn search(
        &self,
        vectors: &dyn Vectors,
        query: &[f32],
        (k, ef): (usize, usize),
        keep: &dyn Fn(usize) -> bool,
    ) -> Vec<ScoredSlot> {
        let points = self.points.read();
        let kept = |point: usize| points.slots[point].iter().flatten().any(|&slot| keep(slot));
        let mut ef = ef.max(k);
        let widest = ef << WIDENINGS;
        let near = loop {
            let mut near = self.hnsw.search(query, ef, ef);
            let has_all = near.len() < ef;
            near.retain(|neighbour| kept(neighbour.d_id));
            if near.len() >= k || has_all || ef >= widest {
                break near;
            }
            ef *= 2;
        };
        let mut candidates: BTreeSet<usize> = near.iter().map(|neighbour| neighbour.d_id).collect();
        candidates.extend(self.stray.read().iter());
        let mut found = Vec::with_capacity(candidates.len());
        for equal in candidates.iter().flat_map(|&point| &points.slots[point]) {
            // Of equal images, the first `k` are enough, with one comparison.
            let mut similarity = None;
            for &slot in equal.iter().filter(|&&slot| keep(slot)).take(k) {
                vectors.scan(slot..slot + 1, &mut |slot, vector| {
                    let similarity = *similarity.get_or_insert_with(|| dot(query, vector));
                    found.push(ScoredSlot { slot, similarity });
                });
            }
        }
        found
    }
}
