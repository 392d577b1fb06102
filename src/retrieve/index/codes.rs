//! Descriptors in 8-bit codes, a quarter of the bytes that a comparison has to fetch.

use multiversion::multiversion;

/// A similarity and the point that has it, in one number that sorts by similarity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Ranked(u64);

impl Ranked {
    pub const WORST: Self = Self(0);

    pub fn new(similarity: f32, point: u32) -> Self {
        let bits = similarity.to_bits();
        let ordered = if bits >> 31 == 0 { bits | 1 << 31 } else { !bits };
        Self(u64::from(ordered) << 32 | u64::from(point))
    }

    pub fn point(self) -> u32 {
        self.0 as u32
    }

    /// Whether its similarity is above that of another, whatever their points.
    pub fn is_nearer_than(self, other: Self) -> bool {
        self.0 >> 32 > other.0 >> 32
    }
}

/// The descriptors of points, one after another.
#[derive(Debug, PartialEq)]
pub(super) struct Codes {
    /// Numbers in each.
    pub dim: usize,
    /// Point → `dim` codes.
    pub codes: Vec<i8>,
    /// Point → what one step of its codes is worth.
    pub scales: Vec<f32>,
}

/// One descriptor.
#[derive(Clone, Copy)]
pub(super) struct Coded<'a> {
    codes: &'a [i8],
    scale: f32,
}

impl Codes {
    pub fn new(dim: usize, points: usize) -> Self {
        Self { dim, codes: Vec::with_capacity(points * dim), scales: Vec::with_capacity(points) }
    }

    /// Puts a descriptor behind the others.
    pub fn push(&mut self, vector: &[f32]) {
        let largest = vector.iter().fold(f32::MIN_POSITIVE, |most, x| most.max(x.abs()));
        let scale = largest / 127.0;
        // Rounded away from zero at halves; the cast keeps within −127..=127.
        self.codes.extend(vector.iter().map(|x| (x / scale).round() as i8));
        self.scales.push(scale);
    }

    pub fn of(&self, point: u32) -> Coded<'_> {
        let point = point as usize;
        let codes = &self.codes[point * self.dim..(point + 1) * self.dim];
        Coded { codes, scale: self.scales[point] }
    }

    /// Reads a number of each line of the cache that the codes of these points take, so that all are on
    /// their way from memory together before they are compared one after another.
    pub fn fetch(&self, points: &[u32]) {
        const LINE: usize = 64;
        let mut all = 0;
        for &point in points {
            let codes = self.of(point).codes;
            let mut at = 0;
            while at < codes.len() {
                all ^= codes[at];
                at += LINE;
            }
        }
        std::hint::black_box(all);
    }

    /// How similar a point is to another descriptor.
    pub fn ranked(&self, to: Coded<'_>, point: u32) -> Ranked {
        let coded = self.of(point);
        let similarity = coded_dot(to.codes, coded.codes) as f32 * (to.scale * coded.scale);
        Ranked::new(similarity, point)
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn coded_dot(a: &[i8], b: &[i8]) -> i32 {
    let length = a.len().min(b.len());
    let (a, b) = (&a[..length], &b[..length]);
    let mut sum = 0;
    // Indices, because adapters of iterators are not always compiled into their caller.
    for index in 0..length {
        sum += i32::from(a[index]) * i32::from(b[index]);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::dot;

    #[test]
    fn what_sorts_later_is_more_similar() {
        let similarities = [-1.0, -0.5, -0.0, 0.0, 1e-9, 0.5, 1.0];
        let ranks: Vec<Ranked> = similarities.iter().map(|&s| Ranked::new(s, 7)).collect();
        assert!(ranks.is_sorted());
        assert_eq!(Ranked::new(-0.3, 12).point(), 12);
        assert!(!Ranked::new(0.3, 2).is_nearer_than(Ranked::new(0.3, 1)));
    }

    #[test]
    fn codes_keep_a_similarity_to_about_a_hundredth() {
        let wave = |phase: f32| -> Vec<f32> {
            let wave: Vec<f32> = (0..384).map(|i| (i as f32 * 0.7 + phase).sin()).collect();
            let norm = wave.iter().map(|x| x * x).sum::<f32>().sqrt();
            wave.iter().map(|x| x / norm).collect()
        };
        let a = wave(0.0);
        for phase in [0.0, 0.3, 1.5, 3.0] {
            let b = wave(phase);
            let mut codes = Codes::new(384, 2);
            codes.push(&a);
            codes.push(&b);
            let coded = coded_dot(codes.of(0).codes, codes.of(1).codes) as f32;
            let coded = coded * codes.scales[0] * codes.scales[1];
            assert!((coded - dot(&a, &b)).abs() < 0.01);
        }
    }
}
