//! Makes every point of a finished graph findable.
//!
//! HNSW keeps links to the nearest neighbours and gives no guarantee that a point has an incoming link at all. Two
//! passes over the lowest layer mend that:
//!
//! 1. Every point becomes reachable from the entry point.
//! 2. Every point is searched for, as a query would; one that the search does not find is linked where the search
//!    ended.
//!
//! Both add links by [`Repair::detour`].

use std::collections::VecDeque;

use rayon::ThreadPool;
use rayon::prelude::*;

use super::codes::Codes;
use super::layer::Layer;
use super::sealed::descend;

/// Rounds of the second pass. A round searches for the points whose links the one before it changed.
const ROUNDS: usize = 8;

pub(super) struct Repair<'a> {
    pub codes: &'a Codes,
    /// The beam width of queries.
    pub ef: usize,
}

impl Repair<'_> {
    pub fn run(&self, layers: &mut [Layer<u32>], threads: &ThreadPool) {
        if layers[0].points() == 0 {
            return;
        }
        self.connect(layers);
        let mut changed: Vec<u32> = (0..layers[0].points() as u32).collect();
        for _ in 0..ROUNDS {
            let lost = self.lost(layers, &changed, threads);
            if lost.is_empty() {
                break;
            }
            changed.clear();
            for (point, nearest) in lost {
                changed.extend(self.detour(&mut layers[0], nearest, point));
            }
            // A detour may take the last link to a neighbour of a point that was reachable before.
            changed.extend(self.connect(layers));
            changed.sort_unstable();
            changed.dedup();
        }
    }

    /// Links every point that cannot be reached from the entry point to the nearest one that can. Returns the points
    /// whose links changed.
    fn connect(&self, layers: &mut [Layer<u32>]) -> Vec<u32> {
        let mut reached = vec![false; layers[0].points()];
        reach(&layers[0], 0, &mut reached);
        let mut changed = Vec::new();
        for point in 0..layers[0].points() as u32 {
            if reached[point as usize] {
                continue;
            }
            let of = self.codes.of(point);
            let entries = descend(layers, self.codes, of);
            let found =
                layers[0].beam(self.codes, of, &entries, self.ef, |other| reached[other as usize]);
            // Entries of the upper layers may themselves be out of reach.
            let nearest = found.first().map_or(0, |ranked| ranked.point());
            changed.extend(self.detour(&mut layers[0], nearest, point));
            reach(&layers[0], point, &mut reached);
        }
        changed
    }

    /// Those of the points that a query for their own descriptor misses, each with the point that the query finds
    /// instead.
    fn lost(&self, layers: &[Layer<u32>], points: &[u32], threads: &ThreadPool) -> Vec<(u32, u32)> {
        let find = |&point: &u32| {
            let of = self.codes.of(point);
            let entries = descend(layers, self.codes, of);
            let found = layers[0].beam(self.codes, of, &entries, self.ef, |_| true);
            let missed = found.iter().all(|ranked| ranked.point() != point);
            Some((point, found.first()?.point())).filter(|_| missed)
        };
        threads.install(|| points.par_iter().filter_map(find).collect())
    }

    /// Links `from` → `to`. If the row of `from` is full, its neighbour nearest to `to` makes room and is linked from
    /// `to` instead: whatever was reached through the old link is reached through `from` → `to` → neighbour. If `to`
    /// was out of reach, nothing that is reachable depends on the link that it gives up, so what can be reached only
    /// grows. Returns the points that gained or lost an incoming link.
    fn detour(&self, layer: &mut Layer<u32>, from: u32, to: u32) -> Vec<u32> {
        let neighbours: Vec<u32> = layer.of(from).collect();
        if from == to || neighbours.contains(&to) {
            return Vec::new();
        }
        if neighbours.len() < layer.degree {
            layer.write(from, neighbours.len(), to);
            return vec![to];
        }
        let of = self.codes.of(to);
        let nearest = (0..neighbours.len())
            .max_by_key(|&place| self.codes.ranked(of, neighbours[place]))
            .unwrap_or(0);
        layer.write(from, nearest, to);
        let moved = neighbours[nearest];
        let row: Vec<u32> = layer.of(to).collect();
        if row.contains(&moved) {
            return vec![to, moved];
        }
        if row.len() < layer.degree {
            layer.write(to, row.len(), moved);
            return vec![to, moved];
        }
        // The farthest neighbour of `to` gives way.
        let farthest = (0..row.len()).min_by_key(|&place| self.codes.ranked(of, row[place]));
        let farthest = farthest.unwrap_or(0);
        layer.write(to, farthest, moved);
        vec![to, moved, row[farthest]]
    }
}

/// Marks what can be reached from `start`.
pub(super) fn reach(layer: &Layer<u32>, start: u32, reached: &mut [bool]) {
    if std::mem::replace(&mut reached[start as usize], true) {
        return;
    }
    let mut open = VecDeque::from([start]);
    while let Some(point) = open.pop_front() {
        for neighbour in layer.of(point) {
            if !std::mem::replace(&mut reached[neighbour as usize], true) {
                open.push_back(neighbour);
            }
        }
    }
}
