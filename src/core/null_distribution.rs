//! The evidence that wrong answers of one map have, and the confidence that follows from it; see
//! [`confidence`](super::confidence).
//!
//! There are two confidences. One bounds the share of unknown places that reach it on average over maps. The other bounds
//! it in nine maps in ten: the values are a sample, and by chance it may lack the most convincing wrong answers.

use serde::{Deserialize, Serialize};

/// The share of maps in which a null distribution may promise too much.
const SURPRISE: f64 = 0.1;

/// Halvings of the interval in which a bound is sought: more than the precision of the result.
const BISECTIONS: usize = 30;

/// Evidence values of wrong answers, sorted ascending.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(from = "Vec<f32>", into = "Vec<f32>")]
pub struct NullDistribution(Vec<f32>);

impl From<Vec<f32>> for NullDistribution {
    fn from(mut values: Vec<f32>) -> Self {
        values.sort_by(f32::total_cmp);
        Self(values)
    }
}

impl From<NullDistribution> for Vec<f32> {
    fn from(null: NullDistribution) -> Self {
        null.0
    }
}

impl NullDistribution {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The highest confidence that evidence can have: n / (n + 1).
    pub fn highest_confidence(&self) -> f32 {
        self.confidence(f32::INFINITY)
    }

    /// Mean of the samples; `None` if there are none.
    pub fn mean(&self) -> Option<f32> {
        let sum: f32 = self.0.iter().sum();
        (!self.is_empty()).then(|| sum / self.len() as f32)
    }

    /// c = #{x < e} / (n + 1), in [0, 1).
    pub(super) fn confidence(&self, evidence: f32) -> f32 {
        let below = self.0.partition_point(|value| *value < evidence);
        below as f32 / (self.len() + 1) as f32
    }

    /// One minus the largest share of wrong answers with at least this evidence that is compatible with the sample:
    /// the one-sided bound of Clopper and Pearson (*The use of confidence or fiducial limits*, 1934) at [`SURPRISE`]. At
    /// most SURPRISE^(1/n), so fewer than 22 samples cannot give 0.9.
    pub(super) fn assured_confidence(&self, evidence: f32) -> f32 {
        let n = self.len();
        let reached = n - self.0.partition_point(|value| *value < evidence);
        if reached == n {
            return 0.0;
        }
        let (mut low, mut high) = (reached as f64 / n as f64, 1.0);
        for _ in 0..BISECTIONS {
            let share = (low + high) / 2.0;
            match at_most(reached, n, share) > SURPRISE {
                true => low = share,
                false => high = share,
            }
        }
        (1.0 - high) as f32
    }
}

/// The probability that at most `most` of `n` trials succeed, each with the probability `share`, for `most` < `n` and
/// `share` from `most / n` to 1.
fn at_most(most: usize, n: usize, share: f64) -> f64 {
    // From the largest term downwards; the terms fall at least geometrically.
    let (k, count) = (most as f64, n as f64);
    let ln_choose = ln_factorial(n) - ln_factorial(most) - ln_factorial(n - most);
    let mut term = (ln_choose + k * share.ln() + (count - k) * (1.0 - share).ln()).exp();
    if most == 0 {
        return (1.0 - share).powi(i32::try_from(n).unwrap_or(i32::MAX));
    }
    let odds = (1.0 - share) / share;
    let mut sum = 0.0;
    for successes in (0..=most).rev() {
        sum += term;
        term *= successes as f64 / (n - successes + 1) as f64 * odds;
        if term < 1e-9 * sum {
            break;
        }
    }
    sum
}

/// ln n!, by Stirling's series.
fn ln_factorial(n: usize) -> f64 {
    if n < 16 {
        return (1..=n).map(|factor| (factor as f64).ln()).sum();
    }
    let x = n as f64;
    let tau = std::f64::consts::TAU;
    x * x.ln() - x + (tau * x).ln() / 2.0 + 1.0 / (12.0 * x) - 1.0 / (360.0 * x.powi(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confidence_bounds_the_false_positive_rate() {
        let null = NullDistribution::from(vec![0.3, 0.1, 0.2, 0.2]);
        let of = |evidence| null.confidence(evidence);
        assert_eq!([of(0.05), of(0.2), of(0.25), of(9.0)], [0.0, 0.2, 0.6, 0.8]);
        // Leave one out: each of 99 values against the other 98.
        let values: Vec<f32> = (0..99).map(|i| ((i * 37) % 99) as f32).collect();
        let confident = (0..99).filter(|&left_out| {
            let mut others = values.clone();
            let one = others.remove(left_out);
            NullDistribution::from(others).confidence(one) >= 0.9
        });
        assert!(confident.count() <= 10);
        assert_eq!(NullDistribution::default().confidence(1.0), 0.0);
    }

    /// Numbers from 0 to 1.
    fn uniforms(seed: u64) -> impl FnMut() -> f32 {
        let mut state = seed.wrapping_mul(6_364_136_223_846_793_005) | 1;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            ((state >> 40) as f32 + 0.5) / (1 << 24) as f32
        }
    }

    /// Numbers of a heavy-tailed distribution, as evidence has.
    fn draws(seed: u64) -> impl FnMut() -> f32 {
        let mut uniform = uniforms(seed);
        move || {
            let uniform = uniform();
            -uniform.ln() + 0.1 / uniform.sqrt()
        }
    }

    #[test]
    fn an_assured_confidence_is_the_bound_of_clopper_and_pearson() {
        let assured = |n: usize, reached: usize| {
            let values = (0..n).map(|value| value as f32).collect::<Vec<f32>>();
            NullDistribution::from(values).assured_confidence((n - reached) as f32)
        };
        // The limits are of exact binomial sums in Python.
        for (n, reached, limit) in [
            (22, 0, 0.09937),
            (21, 0, 0.10385),
            (80, 4, 0.09744),
            (80, 5, 0.11285),
            (179, 12, 0.09773),
            (256, 19, 0.09981),
            (10, 3, 0.55173),
        ] {
            let expected = 1.0 - limit;
            let found = assured(n, reached);
            assert!((found - expected).abs() < 1e-4, "{reached} of {n}: {found}, not {expected}");
        }
        assert_eq!((assured(9, 9), assured(5000, 5000)), (0.0, 0.0));
        // It rises with the evidence, in a large sample too.
        let all: Vec<f32> = (0..=4000).rev().map(|reached| assured(4000, reached)).collect();
        assert!(all.is_sorted() && all[4000] > 0.999, "{:?}", &all[3990..]);
    }

    #[test]
    fn an_assured_confidence_promises_too_much_in_one_map_of_ten() {
        for images in [22, 55, 80, 256] {
            let maps = 1000;
            let broken = (0..maps).filter(|map| {
                // Of a uniform distribution, the share above a value is known.
                let mut uniform = uniforms(map * 1000 + images as u64);
                let null: Vec<f32> = (0..images).map(|_| uniform()).collect();
                let null = NullDistribution::from(null);
                let known_from = null
                    .0
                    .iter()
                    .rev()
                    .take_while(|value| null.assured_confidence(value.next_up()) >= 0.9);
                1.0 - known_from.last().unwrap() > 0.1
            });
            let share = broken.count() as f32 / maps as f32;
            assert!((0.03..=0.13).contains(&share), "{images}: {share}");
        }
    }

    #[test]
    fn of_frames_outside_the_map_at_most_the_promised_share_is_known_in_maps_of_any_size() {
        for images in [2, 8, 9, 10, 20, 55, 80, 256] {
            for known_from in [0.5, 0.9, 0.95] {
                let (maps, frames) = (400, 50);
                let mut known = 0;
                for map in 0..maps {
                    let mut draw = draws(map * 1000 + images as u64);
                    let null: Vec<f32> = (0..images).map(|_| draw()).collect();
                    let null = NullDistribution::from(null);
                    known += (0..frames).filter(|_| null.confidence(draw()) >= known_from).count();
                }
                let share = known as f32 / (maps as usize * frames) as f32;
                // The standard error over maps is at most 0.015.
                assert!(share <= 1.0 - known_from + 0.03, "{images}, {known_from}: {share}");
                let reachable = images as f32 / (images + 1) as f32 >= known_from;
                assert_eq!(share > 0.0, reachable, "{images}, {known_from}: {share}");
            }
        }
    }
}
