//! Reproducible random sampling: a sample of the queries, and bootstrap intervals.

use std::ops::Range;

/// SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014).
#[derive(Debug, Clone)]
struct SplitMix64(u64);

impl SplitMix64 {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform below `bound`, which must not be 0; the bias is below `bound` / 2⁶⁴.
    fn below(&mut self, bound: usize) -> usize {
        ((u128::from(self.bits()) * bound as u128) >> 64) as usize
    }
}

/// Draws `size` of `0..count` without replacement, each subset with equal probability, in ascending order. Returns
/// all of them if there are no more than `size`. The same seed gives the same sample.
pub fn sample(count: usize, size: usize, seed: u64) -> Vec<usize> {
    let mut indices: Vec<usize> = (0..count).collect();
    let size = size.min(count);
    let mut random = SplitMix64(seed);
    // The first steps of a Fisher-Yates shuffle.
    for index in 0..size {
        indices.swap(index, index + random.below(count - index));
    }
    indices.truncate(size);
    indices.sort_unstable();
    indices
}

/// Number of bootstrap resamples.
const RESAMPLES: usize = 2000;

/// The 95 % percentile bootstrap interval of the mean (Efron, 1979): the values are resampled with replacement,
/// and the interval spans the middle 95 % of the means. `None` without values.
pub fn interval(values: &[f64]) -> Option<Range<f64>> {
    if values.is_empty() {
        return None;
    }
    let mut random = SplitMix64(1);
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let sum: f64 = (0..values.len()).map(|_| values[random.below(values.len())]).sum();
            sum / values.len() as f64
        })
        .collect();
    means.sort_unstable_by(f64::total_cmp);
    let quantile = |share: f64| means[(share * (RESAMPLES - 1) as f64).round() as usize];
    Some(quantile(0.025)..quantile(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_a_subset_determined_by_the_seed() {
        let first = sample(1000, 400, 1);
        assert_eq!(first.len(), 400);
        assert!(first.is_sorted_by(|a, b| a < b) && first[399] < 1000);
        assert_eq!(first, sample(1000, 400, 1));
        assert_ne!(first, sample(1000, 400, 2));
        assert_eq!(sample(3, 10, 1), [0, 1, 2]);
    }

    #[test]
    fn every_query_is_equally_likely_to_be_sampled() {
        let mut counts = [0; 10];
        for seed in 0..2000 {
            sample(10, 3, seed).into_iter().for_each(|index| counts[index] += 1);
        }
        // Binomial with mean 600 and standard deviation 20.5.
        assert!(counts.iter().all(|count| (500..700).contains(count)), "{counts:?}");
    }

    #[test]
    fn the_interval_of_a_binomial_matches_the_normal_approximation() {
        let values: Vec<f64> = (0..400).map(|i| if i % 4 == 0 { 0.0 } else { 1.0 }).collect();
        let found = interval(&values).unwrap();
        // 0.75 ± 1.96 · sqrt(0.75 · 0.25 / 400) = 0.75 ± 0.042.
        assert!((found.start - 0.708).abs() < 0.008 && (found.end - 0.792).abs() < 0.008);
        assert_eq!(interval(&[1.0; 20]), Some(1.0..1.0));
        assert_eq!(interval(&[]), None);
    }
}
