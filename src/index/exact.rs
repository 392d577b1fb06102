//! Selection of the `k` best results.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use super::ScoredSlot;

/// Collects the `k` best of all results offered.
pub(super) struct TopK {
    k: usize,
    /// A heap with the worst kept result on top.
    kept: BinaryHeap<WorstFirst>,
}

struct WorstFirst(ScoredSlot);

impl TopK {
    pub fn new(k: usize) -> Self {
        Self { k, kept: BinaryHeap::with_capacity(k.min(1024) + 1) }
    }

    pub fn offer(&mut self, found: ScoredSlot) {
        if self.kept.len() < self.k {
            self.kept.push(WorstFirst(found));
        } else if let Some(mut worst) = self.kept.peek_mut()
            && better(&found, &worst.0) == Ordering::Less
        {
            *worst = WorstFirst(found);
        }
    }

    /// Returns the similarity of the worst of the `k` results, once there are as many.
    pub fn worst(&self) -> Option<f32> {
        self.kept.peek().filter(|_| self.kept.len() >= self.k).map(|worst| worst.0.similarity)
    }

    pub fn into_sorted(self) -> Vec<ScoredSlot> {
        self.kept.into_sorted_vec().into_iter().map(|WorstFirst(found)| found).collect()
    }
}

/// Orders results best first: by descending similarity, then by slot.
fn better(a: &ScoredSlot, b: &ScoredSlot) -> Ordering {
    b.similarity.total_cmp(&a.similarity).then(a.slot.cmp(&b.slot))
}

impl Ord for WorstFirst {
    fn cmp(&self, other: &Self) -> Ordering {
        better(&self.0, &other.0)
    }
}

impl PartialOrd for WorstFirst {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for WorstFirst {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for WorstFirst {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_sorted_and_ties_are_ordered_by_slot() {
        let mut best = TopK::new(3);
        for (slot, similarity) in [(4, 0.5), (1, 0.9), (3, 0.5), (2, 0.1), (0, 0.5)] {
            best.offer(ScoredSlot { slot, similarity });
        }
        let slots: Vec<_> = best.into_sorted().iter().map(|found| found.slot).collect();
        assert_eq!(slots, [1, 0, 3]);
    }
}
