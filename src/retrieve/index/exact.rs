//! Exact search: every descriptor is compared.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use multiversion::multiversion;

use super::Found;

/// The `k` best of all that was offered.
pub(super) struct Best {
    k: usize,
    /// The worst of those kept is on top.
    kept: BinaryHeap<WorstFirst>,
}

struct WorstFirst(Found);

impl Best {
    pub fn new(k: usize) -> Self {
        Self { k, kept: BinaryHeap::with_capacity(k.min(1024) + 1) }
    }

    pub fn offer(&mut self, found: Found) {
        if self.kept.len() < self.k {
            self.kept.push(WorstFirst(found));
        } else if let Some(mut worst) = self.kept.peek_mut()
            && better(&found, &worst.0) == Ordering::Less
        {
            *worst = WorstFirst(found);
        }
    }

    pub fn into_sorted(self) -> Vec<Found> {
        self.kept.into_sorted_vec().into_iter().map(|WorstFirst(found)| found).collect()
    }
}

/// The better one is `Less`: more similar, or as similar and stored earlier.
fn better(a: &Found, b: &Found) -> Ordering {
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

/// The dot product, in 16 running sums so that the compiler can keep them in vector registers.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0.0_f32; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    // Indices, because adapters of iterators are not always compiled into their caller.
    for chunk in 0..a.len().min(b.len()) {
        let (x, y) = (&a[chunk], &b[chunk]);
        for lane in 0..LANES {
            sums[lane] += x[lane] * y[lane];
        }
    }
    let mut sum: f32 = sums.iter().sum();
    for index in 0..a_rest.len().min(b_rest.len()) {
        sum += a_rest[index] * b_rest[index];
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_come_sorted_and_ties_keep_their_order() {
        let mut best = Best::new(3);
        for (slot, similarity) in [(4, 0.5), (1, 0.9), (3, 0.5), (2, 0.1), (0, 0.5)] {
            best.offer(Found { slot, similarity });
        }
        let slots: Vec<_> = best.into_sorted().iter().map(|found| found.slot).collect();
        assert_eq!(slots, [1, 0, 3]);
    }

    #[test]
    fn the_dot_product_takes_any_length() {
        for length in [0, 1, 15, 16, 17, 576] {
            let a: Vec<f32> = (0..length).map(|i| i as f32 % 7.0).collect();
            let expected: f32 = a.iter().map(|x| x * x).sum();
            assert_eq!(dot(&a, &a), expected);
        }
    }
}
