//! Repeatable chance: a sample of the queries, and bootstrap intervals.

use std::ops::Range;

/// SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014).
#[derive(Debug, Clone)]
struct Dice(u64);

impl Dice {
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

/// `size` of `0..count`, each subset as likely as any other, in ascending order; all of them if
/// there are no more. The same seed gives the same sample.
pub fn sample(count: usize, size: usize, seed: u64) -> Vec<usize> {
    let mut places: Vec<usize> = (0..count).collect();
    let size = size.min(count);
    let mut dice = Dice(seed);
    // The first steps of a Fisher-Yates shuffle.
    for place in 0..size {
        places.swap(place, place + dice.below(count - place));
    }
    places.truncate(size);
    places.sort_unstable();
    places
}

/// How many times the queries are drawn anew.
const DRAWS: usize = 2000;

/// The 95 % percentile bootstrap interval of the mean (Efron, 1979): the queries are drawn anew
/// with replacement, and the interval spans the middle 95 % of the means. `None` without values.
pub fn interval(values: &[f64]) -> Option<Range<f64>> {
    if values.is_empty() {
        return None;
    }
    let mut dice = Dice(1);
    let mut means: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let sum: f64 = (0..values.len()).map(|_| values[dice.below(values.len())]).sum();
            sum / values.len() as f64
        })
        .collect();
    means.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| means[(share * (DRAWS - 1) as f64).round() as usize];
    Some(at(0.025)..at(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_a_subset_that_the_seed_decides() {
        let first = sample(1000, 400, 1);
        assert_eq!(first.len(), 400);
        assert!(first.is_sorted_by(|a, b| a < b) && first[399] < 1000);
        assert_eq!(first, sample(1000, 400, 1));
        assert_ne!(first, sample(1000, 400, 2));
        assert_eq!(sample(3, 10, 1), [0, 1, 2]);
    }

    #[test]
    fn every_query_is_as_likely_to_be_in_a_sample() {
        let mut times = [0; 10];
        for seed in 0..2000 {
            sample(10, 3, seed).into_iter().for_each(|place| times[place] += 1);
        }
        // Binomial with mean 600 and standard deviation 20.5.
        assert!(times.iter().all(|times| (500..700).contains(times)), "{times:?}");
    }

    #[test]
    fn an_interval_is_that_of_a_binomial() {
        let values: Vec<f64> = (0..400).map(|i| if i % 4 == 0 { 0.0 } else { 1.0 }).collect();
        let found = interval(&values).unwrap();
        // 0.75 ± 1.96 · sqrt(0.75 · 0.25 / 400) = 0.75 ± 0.042.
        assert!((found.start - 0.708).abs() < 0.008 && (found.end - 0.792).abs() < 0.008);
        assert_eq!(interval(&[1.0; 20]), Some(1.0..1.0));
        assert_eq!(interval(&[]), None);
    }
}
