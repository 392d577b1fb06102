//! Descriptors quantized to 8 bits a number: a comparison fetches a quarter of the bytes.

use multiversion::multiversion;

/// A point and its similarity to a query, packed into one integer that sorts by similarity.
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

    pub fn similarity(self) -> f32 {
        let ordered = (self.0 >> 32) as u32;
        f32::from_bits(if ordered >> 31 == 1 { ordered ^ 1 << 31 } else { !ordered })
    }

    /// Whether its similarity is greater than that of `other`, regardless of the points.
    pub fn is_nearer_than(self, other: Self) -> bool {
        self.0 >> 32 > other.0 >> 32
    }
}

/// The quantized descriptors of all points, in one array.
#[derive(Debug, PartialEq)]
pub(super) struct Codes {
    /// Numbers in each.
    pub dim: usize,
    /// Point → `dim` codes.
    pub codes: Vec<i8>,
    /// Point → the value of one step of its codes.
    pub scales: Vec<f32>,
}

/// One quantized descriptor.
#[derive(Clone, Copy, PartialEq)]
pub(super) struct Coded<'a> {
    codes: &'a [i8],
    scale: f32,
}

impl Coded<'_> {
    /// A bound on the error of the similarity of two codes: four standard deviations. Rounding errors are uniform
    /// within half a step, of variance step² / 12, and the other descriptor has unit norm.
    pub fn error(&self, other: Self) -> f32 {
        4.0 * ((self.scale.powi(2) + other.scale.powi(2)) / 12.0).sqrt()
    }

    /// A hash of the codes and their scale; equal descriptors have equal hashes.
    pub fn hash(&self) -> u64 {
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(bytemuck::cast_slice(self.codes));
        let low = hasher.clone().finalize();
        hasher.update(&self.scale.to_le_bytes());
        u64::from(hasher.finalize()) << 32 | u64::from(low)
    }
}

impl Codes {
    pub fn new(dim: usize, points: usize) -> Self {
        Self { dim, codes: Vec::with_capacity(points * dim), scales: Vec::with_capacity(points) }
    }

    /// Quantizes a descriptor and appends it. The scale keeps its norm, so that the similarity of two codes is a
    /// cosine: no other code is more similar to a descriptor than its own.
    pub fn push(&mut self, vector: &[f32]) {
        let largest = vector.iter().fold(f32::MIN_POSITIVE, |most, x| most.max(x.abs()));
        let step = largest / 127.0;
        let start = self.codes.len();
        // Rounded half away from zero; the values are within −127..=127.
        self.codes.extend(vector.iter().map(|x| (x / step).round() as i8));
        let coded = &self.codes[start..];
        let squares: i64 = coded.iter().map(|&x| i64::from(x).pow(2)).sum();
        let norm = vector.iter().map(|x| x * x).sum::<f32>().sqrt();
        self.scales.push(if squares == 0 { step } else { norm / (squares as f32).sqrt() });
    }

    /// Removes the last descriptor.
    pub fn pop(&mut self) {
        self.scales.pop();
        self.codes.truncate(self.scales.len() * self.dim);
    }

    /// Keeps the codes of these points only, in this order.
    pub fn permuted(&self, points: &[u32]) -> Self {
        let mut kept = Self::new(self.dim, points.len());
        for &point in points {
            let Coded { codes, scale } = self.of(point);
            kept.codes.extend_from_slice(codes);
            kept.scales.push(scale);
        }
        kept
    }

    pub fn of(&self, point: u32) -> Coded<'_> {
        let point = point as usize;
        let codes = &self.codes[point * self.dim..(point + 1) * self.dim];
        Coded { codes, scale: self.scales[point] }
    }

    /// Prefetches the codes of these points: reads one number of each cache line, so that the loads overlap
    /// instead of following one another during the comparisons.
    pub fn prefetch(&self, points: &[u32]) {
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
    // Indices, because iterator adapters are not always inlined here.
    for index in 0..length {
        sum += i32::from(a[index]) * i32::from(b[index]);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::dot;

    #[test]
    fn ranked_points_sort_by_similarity() {
        let similarities = [-1.0, -0.5, -0.0, 0.0, 1e-9, 0.5, 1.0];
        let ranks: Vec<Ranked> = similarities.iter().map(|&s| Ranked::new(s, 7)).collect();
        assert!(ranks.is_sorted());
        assert_eq!(Ranked::new(-0.3, 12).point(), 12);
        similarities.iter().for_each(|&s| assert_eq!(Ranked::new(s, 7).similarity(), s));
        assert!(!Ranked::new(0.3, 2).is_nearer_than(Ranked::new(0.3, 1)));
    }

    #[test]
    fn quantization_changes_a_similarity_by_less_than_a_hundredth() {
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
