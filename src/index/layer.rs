//! One layer of a graph: rows of neighbours.

use std::sync::atomic::{AtomicU32, Ordering};

use super::beam::Beam;
use super::codes::{Coded, Codes, Ranked};

/// Fills the unused cells of a row.
pub(super) const NONE: u32 = u32::MAX;

/// The neighbours of the points below [`Layer::points`], in rows.
///
/// Points of higher layers have lower numbers, so a layer holds the points from 0 on. While a graph is built its
/// cells are atomic: a reader of a row that is being written sees a mixture of old and new neighbours, all of them
/// valid.
#[derive(Debug, PartialEq)]
pub(super) struct Layer<C> {
    /// Cells of a row.
    pub degree: usize,
    /// Point → `degree` neighbours.
    pub cells: Vec<C>,
}

/// A cell that holds the number of a neighbour.
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
    /// A layer without any neighbours.
    pub fn new(points: usize, degree: usize) -> Self {
        Self { degree, cells: (0..points * degree).map(|_| AtomicU32::new(NONE)).collect() }
    }

    /// Replaces the neighbours of a point by at most `degree` others. The caller serialises writes to a row.
    pub fn set(&self, point: u32, neighbours: &[u32]) {
        let filled = neighbours.iter().copied().chain(std::iter::repeat(NONE));
        for (cell, neighbour) in self.row(point).iter().zip(filled) {
            cell.store(neighbour, Ordering::Relaxed);
        }
    }

    /// Writes one cell of the row of a point.
    pub fn put(&self, point: u32, place: usize, neighbour: u32) {
        self.row(point)[place].store(neighbour, Ordering::Relaxed);
    }

    /// The finished layer.
    pub fn sealed(self) -> Layer<u32> {
        let cells = self.cells.into_iter().map(AtomicU32::into_inner).collect();
        Layer { degree: self.degree, cells }
    }
}

impl Layer<u32> {
    /// Writes one cell of the row of a point.
    pub fn write(&mut self, point: u32, place: usize, neighbour: u32) {
        self.cells[point as usize * self.degree + place] = neighbour;
    }

    /// Whether the layer has at most `points` points, and every neighbour is one of the layer.
    pub fn is_within(&self, points: usize) -> bool {
        let own = self.points();
        own <= points
            && own * self.degree == self.cells.len()
            && self.cells.iter().all(|&cell| cell == NONE || (cell as usize) < own)
    }
}

impl<C: Cell> Layer<C> {
    /// The number of points.
    pub fn points(&self) -> usize {
        self.cells.len() / self.degree.max(1)
    }

    pub fn row(&self, point: u32) -> &[C] {
        &self.cells[point as usize * self.degree..][..self.degree]
    }

    /// The neighbours of a point.
    pub fn of(&self, point: u32) -> impl Iterator<Item = u32> {
        self.row(point).iter().map(C::get).take_while(|neighbour| *neighbour != NONE)
    }

    /// The `ef` points most similar to `query` among those that `keep` accepts, the nearest first. Starts at
    /// `entries`.
    pub fn beam(
        &self,
        codes: &Codes,
        query: Coded<'_>,
        entries: &[Ranked],
        ef: usize,
        keep: impl Fn(u32) -> bool,
    ) -> Vec<Ranked> {
        Beam::new((self, codes), query, entries, ef, keep).run().nearest()
    }
}
