//! Makes every point of a finished graph findable.
//!
//! HNSW keeps links to the nearest neighbours and gives no guarantee that a point has an incoming link at all. Two
//! passes over the lowest layer mend that:
//!
//! 1. Every point becomes reachable from the entry point.
//! 2. Every point is searched for, as a query would; one that the search does not find is linked where the search
//!    ended. Then the points whose links this changed are searched for, and so on, for some rounds.
//!
//! Both add links by [`Repair::detour`].

use std::collections::VecDeque;

use rayon::ThreadPool;
use rayon::prelude::*;

use super::layer::Layer;
use super::sealed::{SealedGraph, descend};

/// Rounds of the second pass.
const ROUNDS: usize = 8;

/// A graph under repair.
pub(super) struct Repair {
    graph: SealedGraph,
    /// The beam width of queries.
    ef: usize,
    /// Rounds that are left, with this one.
    rounds: usize,
    /// Points to search for in this round; those below `next` are done.
    due: Vec<u32>,
    next: usize,
    /// Points that a query for their own descriptor missed in this round, each with the point that it found instead.
    lost: Vec<(u32, u32)>,
}

impl Repair {
    /// Makes every point reachable. `ef` is the beam width of queries.
    pub fn new(graph: SealedGraph, ef: usize) -> Self {
        let due = (0..graph.layers[0].points() as u32).collect();
        let mut repair = Self { graph, ef, rounds: ROUNDS, due, next: 0, lost: Vec::new() };
        repair.connect();
        repair
    }

    /// Searches for up to `most` more points; returns whether the repair is complete.
    pub fn advance(&mut self, most: usize, threads: &ThreadPool) -> bool {
        let end = self.due.len().min(self.next + most);
        let (graph, ef) = (&self.graph, self.ef);
        let find = |&point: &u32| find_instead(graph, point, ef).map(|found| (point, found));
        let due = &self.due[self.next..end];
        let lost: Vec<(u32, u32)> = threads.install(|| due.par_iter().filter_map(find).collect());
        self.lost.extend(lost);
        self.next = end;
        if end < self.due.len() {
            return false;
        }
        self.rounds -= 1;
        if self.lost.is_empty() {
            return true;
        }
        self.start_round();
        self.rounds == 0
    }

    /// The repaired graph.
    pub fn finish(self) -> SealedGraph {
        self.graph
    }

    /// Links the lost points. The points whose links this changes are due next.
    fn start_round(&mut self) {
        let mut changed = Vec::new();
        for (point, nearest) in std::mem::take(&mut self.lost) {
            changed.extend(self.detour(nearest, point));
        }
        // A detour may take the last link to a neighbour of a point that was reachable before.
        changed.extend(self.connect());
        changed.sort_unstable();
        changed.dedup();
        (self.due, self.next) = (changed, 0);
    }

    /// Links every point that cannot be reached from the entry point to the nearest one that can. Returns the points
    /// whose links changed.
    fn connect(&mut self) -> Vec<u32> {
        let points = self.graph.layers[0].points();
        let mut reached = vec![false; points];
        if points > 0 {
            reach(&self.graph.layers[0], 0, &mut reached);
        }
        let mut changed = Vec::new();
        for point in 0..points as u32 {
            if reached[point as usize] {
                continue;
            }
            let SealedGraph { layers, codes, .. } = &self.graph;
            let of = codes.of(point);
            let entries = descend(layers, codes, of);
            let found =
                layers[0].beam(codes, of, &entries, self.ef, |other| reached[other as usize]);
            // Entries of the upper layers may themselves be out of reach.
            let nearest = found.first().map_or(0, |ranked| ranked.point());
            changed.extend(self.detour(nearest, point));
            reach(&self.graph.layers[0], point, &mut reached);
        }
        changed
    }

    /// Links `from` → `to`. If the row of `from` is full, its neighbour nearest to `to` makes room and is linked from
    /// `to` instead: whatever was reached through the old link is reached through `from` → `to` → neighbour. If `to`
    /// was out of reach, nothing that is reachable depends on the link that it gives up, so what can be reached only
    /// grows. Returns the points that gained or lost an incoming link.
    fn detour(&mut self, from: u32, to: u32) -> Vec<u32> {
        let SealedGraph { layers, codes, .. } = &mut self.graph;
        let layer = &mut layers[0];
        let neighbours: Vec<u32> = layer.of(from).collect();
        if from == to || neighbours.contains(&to) {
            return Vec::new();
        }
        if neighbours.len() < layer.degree {
            layer.write(from, neighbours.len(), to);
            return vec![to];
        }
        let of = codes.of(to);
        let nearest = (0..neighbours.len())
            .max_by_key(|&place| codes.ranked(of, neighbours[place]))
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
        let farthest = (0..row.len()).min_by_key(|&place| codes.ranked(of, row[place]));
        let farthest = farthest.unwrap_or(0);
        layer.write(to, farthest, moved);
        vec![to, moved, row[farthest]]
    }
}

/// The point that a query for the descriptor of `point` finds first, if it does not find `point`.
fn find_instead(graph: &SealedGraph, point: u32, ef: usize) -> Option<u32> {
    let of = graph.codes.of(point);
    let entries = descend(&graph.layers, &graph.codes, of);
    let found = graph.layers[0].beam(&graph.codes, of, &entries, ef, |_| true);
    let missed = found.iter().all(|ranked| ranked.point() != point);
    found.first().map(|first| first.point()).filter(|_| missed)
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
