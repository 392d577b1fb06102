//! One layer of a graph: who is whose neighbour, and the search along that.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicU32, Ordering};

use super::codes::{Coded, Codes, Ranked};

/// Fills rows of neighbours that are shorter than the longest.
const NONE: u32 = u32::MAX;

/// The neighbours of the points below [`Layer::points`], in rows.
///
/// Points are numbered so that those of a higher layer come before those that are in lower ones
/// only. While a graph is built its cells are atomic: who reads a row that is just written sees old
/// and new neighbours, each of which is one.
#[derive(Debug, PartialEq)]
pub(super) struct Layer<C> {
    /// Cells of a row.
    pub degree: usize,
    /// Point → `degree` neighbours.
    pub cells: Vec<C>,
}

/// Where the number of a neighbour is kept.
pub(super) trait Cell {
    fn get(&self) -> u32;
}

impl Cell for u32 {
    #[inline]
    fn get(&self) -> u32 {
        *self
    }
}

impl Cell for AtomicU32 {
    #[inline]
    fn get(&self) -> u32 {
        self.load(Ordering::Relaxed)
    }
}

impl Layer<AtomicU32> {
    /// A layer in which nobody has neighbours.
    pub fn new(points: usize, degree: usize) -> Self {
        Self { degree, cells: (0..points * degree).map(|_| AtomicU32::new(NONE)).collect() }
    }

    /// Replaces the neighbours of a point, at most `degree`. Not for two threads at a time.
    pub fn set(&self, point: u32, neighbours: &[u32]) {
        let filled = neighbours.iter().copied().chain(std::iter::repeat(NONE));
        for (cell, neighbour) in self.row(point).iter().zip(filled) {
            cell.store(neighbour, Ordering::Relaxed);
        }
    }

    /// Puts a neighbour in its place in the row of a point.
    pub fn put(&self, point: u32, place: usize, neighbour: u32) {
        self.row(point)[place].store(neighbour, Ordering::Relaxed);
    }

    /// The layer as it is from now on.
    pub fn sealed(self) -> Layer<u32> {
        let cells = self.cells.into_iter().map(AtomicU32::into_inner).collect();
        Layer { degree: self.degree, cells }
    }
}

impl<C: Cell> Layer<C> {
    /// How many points are in it.
    pub fn points(&self) -> usize {
        self.cells.len() / self.degree.max(1)
    }

    fn row(&self, point: u32) -> &[C] {
        &self.cells[point as usize * self.degree..][..self.degree]
    }

    /// The neighbours of a point.
    pub fn of(&self, point: u32) -> impl Iterator<Item = u32> {
        self.row(point).iter().map(C::get).take_while(|neighbour| *neighbour != NONE)
    }

    /// The `ef` points most similar to `query` that `keep` lets through, the nearest first: Malkov
    /// and Yashunin (2018), algorithm 2. It begins at `entries`.
    pub fn beam(
        &self,
        codes: &Codes,
        query: Coded<'_>,
        entries: &[Ranked],
        ef: usize,
        keep: impl Fn(u32) -> bool,
    ) -> Vec<Ranked> {
        let mut seen = vec![0_u64; self.points().div_ceil(64)];
        let mut see = |point: u32| {
            let (word, bit) = (&mut seen[point as usize / 64], 1 << (point % 64));
            let new = *word & bit == 0;
            *word |= bit;
            new
        };
        let mut open = BinaryHeap::with_capacity(2 * ef);
        let mut best: BinaryHeap<Reverse<Ranked>> = BinaryHeap::with_capacity(ef + 1);
        for &entry in entries {
            see(entry.point());
            open.push(entry);
            if keep(entry.point()) {
                best.push(Reverse(entry));
            }
        }
        while best.len() > ef {
            best.pop();
        }
        let worst_of = |best: &BinaryHeap<Reverse<Ranked>>| {
            best.peek().filter(|_| best.len() >= ef).map_or(Ranked::WORST, |worst| worst.0)
        };
        let mut fresh = Vec::with_capacity(self.degree);
        while let Some(nearest) = open.pop() {
            if nearest < worst_of(&best) {
                break;
            }
            fresh.clear();
            // A loop, because adapters of iterators are not always compiled into their caller.
            for cell in self.row(nearest.point()) {
                let point = cell.get();
                if point == NONE {
                    break;
                }
                if see(point) {
                    fresh.push(point);
                }
            }
            codes.fetch(&fresh);
            for &point in &fresh {
                let candidate = codes.ranked(query, point);
                if candidate > worst_of(&best) {
                    open.push(candidate);
                    if keep(point) {
                        best.push(Reverse(candidate));
                        if best.len() > ef {
                            best.pop();
                        }
                    }
                }
            }
        }
        best.into_sorted_vec().into_iter().map(|Reverse(ranked)| ranked).collect()
    }
}
