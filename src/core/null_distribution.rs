//! The evidence that wrong answers of one map have, and the confidence that follows from it; see
//! [`confidence`](super::confidence).

use serde::{Deserialize, Serialize};

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

    /// Numbers of a heavy-tailed distribution, as evidence has.
    fn draws(seed: u64) -> impl FnMut() -> f32 {
        let mut state = seed.wrapping_mul(6_364_136_223_846_793_005) | 1;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let uniform = ((state >> 40) as f32 + 0.5) / (1 << 24) as f32;
            -uniform.ln() + 0.1 / uniform.sqrt()
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
