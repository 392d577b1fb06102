//! The beam search over one layer of a graph: Malkov and Yashunin (2018), algorithm 2, which can go on with a wider
//! beam where a narrow one ended.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::codes::{Coded, Codes, Ranked};
use super::layer::{Cell, Layer, NONE};

/// How many points a search of the usual kind expands until its result no longer changes. One with a beam of width
/// `ef` has converged when it went on for `ef` divided by this many times as long as it took to its result, so that
/// `ef` is its patience too.
const USUAL: usize = 24;

/// A search for the points most similar to `query` among those that `keep` accepts.
pub(super) struct Beam<'a, C, K> {
    layer: &'a Layer<C>,
    codes: &'a Codes,
    query: Coded<'a>,
    keep: K,
    /// The width: how many points the search keeps in view.
    ef: usize,
    /// A bit for each point, set once its similarity was computed.
    seen: Vec<u64>,
    /// Points whose neighbours were not looked at yet.
    open: BinaryHeap<Ranked>,
    /// The `ef` most similar points so far.
    best: BinaryHeap<Reverse<Ranked>>,
    /// What a wider beam needs. `None` if the search will not be widened.
    wider: Option<Wider>,
}

/// What a beam leaves aside, and how its result changed.
struct Wider {
    /// Points that were not similar enough to be opened.
    refused: Vec<Ranked>,
    /// Points that more similar ones displaced from `best`.
    displaced: Vec<Ranked>,
    /// The `k` most similar points so far.
    top: BinaryHeap<Reverse<Ranked>>,
    k: usize,
    /// The width of the first beam.
    patience: usize,
    expanded: usize,
    /// How many points had been expanded when `top` changed last.
    changed: usize,
}

impl Wider {
    fn offer(&mut self, candidate: Ranked) {
        if self.top.len() == self.k {
            if self.top.peek().is_none_or(|worst| candidate <= worst.0) {
                return;
            }
            self.top.pop();
        }
        self.top.push(Reverse(candidate));
        self.changed = self.expanded;
    }
}

impl<'a, C: Cell, K: Fn(u32) -> bool> Beam<'a, C, K> {
    /// A search that starts at `entries`.
    pub fn new(
        (layer, codes): (&'a Layer<C>, &'a Codes),
        query: Coded<'a>,
        entries: &[Ranked],
        ef: usize,
        keep: K,
    ) -> Self {
        let mut beam = Self {
            layer,
            codes,
            query,
            keep,
            ef,
            seen: vec![0; layer.points().div_ceil(64)],
            open: BinaryHeap::with_capacity(2 * ef),
            best: BinaryHeap::with_capacity(ef + 1),
            wider: None,
        };
        for &entry in entries {
            beam.see(entry.point());
            beam.open.push(entry);
            if (beam.keep)(entry.point()) {
                beam.best.push(Reverse(entry));
            }
        }
        beam.trim();
        beam
    }

    /// Lets the search be widened, and watches its `k` best.
    pub fn widening(mut self, k: usize) -> Self {
        let mut wider = Wider {
            refused: Vec::new(),
            displaced: Vec::new(),
            top: BinaryHeap::with_capacity(k + 1),
            k,
            patience: self.ef,
            expanded: 0,
            changed: 0,
        };
        self.best.iter().for_each(|entry| wider.offer(entry.0));
        self.wider = Some(wider);
        self
    }

    /// Searches until no open point is among the `ef` most similar.
    pub fn run(mut self) -> Self {
        let mut fresh = Vec::with_capacity(self.layer.degree);
        while let Some(&nearest) = self.open.peek() {
            if nearest < self.worst() {
                break;
            }
            self.open.pop();
            if let Some(wider) = &mut self.wider {
                wider.expanded += 1;
            }
            fresh.clear();
            let layer = self.layer;
            // A loop, because iterator adapters are not always inlined here.
            for cell in layer.row(nearest.point()) {
                let point = cell.get();
                if point == NONE {
                    break;
                }
                if self.see(point) {
                    fresh.push(point);
                }
            }
            self.codes.prefetch(&fresh);
            for &point in &fresh {
                self.offer(self.codes.ranked(self.query, point));
            }
        }
        self
    }

    /// Goes on with a wider beam.
    pub fn widen(mut self, ef: usize) -> Self {
        self.ef = ef;
        if let Some(wider) = &mut self.wider {
            let refused = std::mem::take(&mut wider.refused);
            let displaced = std::mem::take(&mut wider.displaced);
            let kept = refused.iter().copied().filter(|ranked| (self.keep)(ranked.point()));
            self.best.extend(kept.chain(displaced).map(Reverse));
            self.open.extend(refused);
            self.trim();
        }
        self.run()
    }

    /// Whether the `k` best have not changed for so long that a wider beam would hardly change them.
    pub fn has_converged(&self) -> bool {
        let converged = |wider: &Wider| wider.expanded * USUAL >= wider.patience * wider.changed;
        self.wider.as_ref().is_none_or(converged)
    }

    /// Whether there are fewer points than the beam is wide.
    pub fn has_all(&self) -> bool {
        self.best.len() < self.ef
    }

    /// The `ef` most similar points, the nearest first.
    pub fn nearest(&self) -> Vec<Ranked> {
        let mut nearest: Vec<Ranked> = self.best.iter().map(|ranked| ranked.0).collect();
        nearest.sort_unstable_by_key(|ranked| Reverse(*ranked));
        nearest
    }

    fn offer(&mut self, candidate: Ranked) {
        if candidate <= self.worst() {
            if let Some(wider) = &mut self.wider {
                wider.refused.push(candidate);
            }
            return;
        }
        self.open.push(candidate);
        if !(self.keep)(candidate.point()) {
            return;
        }
        if let Some(wider) = &mut self.wider {
            wider.offer(candidate);
        }
        self.best.push(Reverse(candidate));
        if self.best.len() > self.ef {
            self.displace();
        }
    }

    fn trim(&mut self) {
        while self.best.len() > self.ef {
            self.displace();
        }
    }

    fn displace(&mut self) {
        if let (Some(Reverse(worst)), Some(wider)) = (self.best.pop(), &mut self.wider) {
            wider.displaced.push(worst);
        }
    }

    /// The worst of the `ef` most similar points, if there are as many.
    fn worst(&self) -> Ranked {
        let full = self.best.peek().filter(|_| self.best.len() >= self.ef);
        full.map_or(Ranked::WORST, |worst| worst.0)
    }

    /// Marks a point; returns whether it is new.
    fn see(&mut self, point: u32) -> bool {
        let (word, bit) = (&mut self.seen[point as usize / 64], 1 << (point % 64));
        let new = *word & bit == 0;
        *word |= bit;
        new
    }
}
