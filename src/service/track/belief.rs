//! A discrete Bayes filter over the images of a map (Thrun, Burgard and Fox, *Probabilistic Robotics*,
//! 2005, chapter 4): where a robot is, given all its frames so far.
//!
//! Every frame takes two steps. *Move*: with i and j images of the map,
//!
//! > p′(j) = (1 − ε) Σ p(i) T(i → j) + ε / N
//!
//! where T falls off as a Gaussian beyond the distance that the robot can have moved, or about the one
//! that its odometry says, and ε is the chance that it is anywhere. *Weigh*:
//!
//! > p(j) ∝ p′(j) · (ω + (1 − ω) e(j) / ē),  e(j) = exp(β (s(j) − s₁) / g)
//!
//! with the similarity s(j) of the frame and the image, s₁ the highest, ē the mean of e over all images,
//! and g the gap that chance leaves between the first wrong answer and the median of the next, which is
//! measured in the map ([`Evidence`](whereabouts_core::Evidence)). ω is the share of frames that say
//! nothing, because a bus stands before the camera: no single frame can outvote the others for ever.
//!
//! Only the images that are likely are kept; the rest of the probability is spread evenly over the map.

use super::TrackSettings;
use super::places::Places;
use whereabouts_core::ImageId;

/// Beyond so many standard deviations a Gaussian is nothing.
const TAIL: f64 = 3.0;

/// From one image, a robot may have moved to so many; what could have gone to more is spread over all.
const REACHED: usize = 512;

/// How far a robot has come since its last frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Motion {
    /// Anywhere up to so many metres.
    Within(f64),
    /// So many metres, says its odometry.
    By(f64),
}

/// Where a robot may be.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Belief {
    /// Images by number, each with its probability beyond its share of `elsewhere`, in ascending order
    /// of the numbers.
    likely: Vec<(u32, f64)>,
    /// What is spread evenly over all images.
    elsewhere: f64,
}

impl Belief {
    /// Nothing is known.
    pub fn anywhere() -> Self {
        Self { likely: Vec::new(), elsewhere: 1.0 }
    }

    /// The robot has moved.
    pub fn after(&self, motion: Motion, places: &Places, settings: &TrackSettings) -> Self {
        let width = places.spacing() / 2.0;
        let (low, high, width) = match motion {
            Motion::Within(reach) => (0.0, reach, width),
            // Wheels slip, and a way is not straight.
            Motion::By(way) => (way, way, width + settings.odometry_error * way),
        };
        let mut moved = Vec::new();
        let mut elsewhere = self.elsewhere;
        for &(image, probability) in &self.likely {
            let reached = places.near(image, high + TAIL * width, REACHED).unwrap_or_default();
            let weight = |distance: f64| {
                let off = (low - distance).max(distance - high).max(0.0) / width;
                // Else the least unlikely image would be certain, however unlikely.
                if off > TAIL { 0.0 } else { (-0.5 * off * off).exp() }
            };
            let total: f64 = reached.iter().map(|(_, distance)| weight(*distance)).sum();
            if total > f64::MIN_POSITIVE {
                let share =
                    |(to, distance): (u32, f64)| (to, probability * weight(distance) / total);
                moved.extend(reached.into_iter().map(share));
            } else {
                elsewhere += probability;
            }
        }
        for (_, probability) in &mut moved {
            *probability *= 1.0 - settings.jump;
        }
        Self { likely: merged(moved), elsewhere: elsewhere + settings.jump * (1.0 - elsewhere) }
    }

    /// A frame has come. `similarities` are those of the images most like it; that of every other image
    /// is taken for the least of these. `gap` is g above.
    pub fn given(
        &self,
        similarities: &[(u32, f32)],
        gap: f32,
        places: &Places,
        settings: &TrackSettings,
    ) -> Self {
        let all = places.len() as f64;
        let [mut first, mut last] = [f32::NEG_INFINITY, f32::INFINITY];
        for (_, similarity) in similarities {
            first = first.max(*similarity);
            last = last.min(*similarity);
        }
        if similarities.is_empty() || all < 1.0 {
            return self.clone();
        }
        let speaks = |similarity: f32| {
            f64::from(settings.sharpness as f32 * (similarity - first) / gap).exp()
        };
        let rest = speaks(last);
        let sum: f64 = similarities.iter().map(|(_, similarity)| speaks(*similarity)).sum();
        let mean = (sum + (all - similarities.len() as f64).max(0.0) * rest) / all;
        let weight = |spoken: f64| settings.outliers + (1.0 - settings.outliers) * spoken / mean;

        let even = self.elsewhere / all;
        // Every likely image and every similar one, each with what it had.
        let mut weighed: Vec<(u32, f64)> = self.likely.clone();
        weighed.extend(similarities.iter().map(|(image, _)| (*image, 0.0)));
        let mut weighed = merged(weighed);
        let mut sorted = similarities.to_vec();
        sorted.sort_by_key(|(image, _)| *image);
        for (image, probability) in &mut weighed {
            let known = sorted.binary_search_by_key(image, |(similar, _)| *similar);
            let spoken = known.map_or(rest, |at| speaks(sorted[at].1));
            *probability = (*probability + even) * weight(spoken);
        }
        let elsewhere = even * (all - weighed.len() as f64).max(0.0) * weight(rest);
        Self { likely: weighed, elsewhere }.kept(settings.states)
    }

    /// The most probable images, with the rest of the probability elsewhere; of sum 1.
    fn kept(mut self, most: usize) -> Self {
        if self.likely.len() > most {
            self.likely.sort_by(|a, b| b.1.total_cmp(&a.1));
            self.elsewhere += self.likely.drain(most..).map(|(_, p)| p).sum::<f64>();
            self.likely.sort_by_key(|(image, _)| *image);
        }
        let total = self.elsewhere + self.likely.iter().map(|(_, p)| p).sum::<f64>();
        if !total.is_normal() {
            return Self::anywhere();
        }
        self.elsewhere /= total;
        self.likely.iter_mut().for_each(|(_, probability)| *probability /= total);
        self
    }

    /// The most probable image, and the probability that the robot is within `radius` metres of it.
    pub fn best(&self, places: &Places, radius: f64) -> Option<(u32, f64)> {
        let (best, _) =
            self.likely.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))?;
        let near = self.likely.iter().filter(|(image, _)| places.distance(*best, *image) <= radius);
        Some((*best, near.map(|(_, probability)| probability).sum()))
    }

    /// The likely images by their ids, which outlive a change of the map.
    pub fn named(&self, places: &Places) -> Vec<(ImageId, f64)> {
        self.likely.iter().map(|(image, p)| (places.id(*image).clone(), *p)).collect()
    }

    /// What was [`named`](Self::named) before. Images that are gone are nowhere.
    pub fn remembered(named: &[(ImageId, f64)], places: &Places) -> Self {
        let known = named.iter().filter_map(|(id, p)| Some((places.number(id)?, *p)));
        let likely = merged(known.collect());
        let elsewhere = (1.0 - likely.iter().map(|(_, p)| p).sum::<f64>()).max(0.0);
        Self { likely, elsewhere }
    }

    /// Leaves an image out.
    pub fn without(mut self, image: u32) -> Self {
        self.likely.retain(|(other, _)| *other != image);
        let most = self.likely.len();
        self.kept(most)
    }
}

/// In ascending order, each image once.
fn merged(mut parts: Vec<(u32, f64)>) -> Vec<(u32, f64)> {
    parts.sort_by_key(|(image, _)| *image);
    parts.dedup_by(|next, kept| {
        let same = next.0 == kept.0;
        if same {
            kept.1 += next.1;
        }
        same
    });
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::{MetricPose, Pose};

    /// Images every ten metres along a road.
    fn road(count: usize) -> Places {
        let at = |x: f64| {
            Pose::Metric(MetricPose { x, y: 0.0, z: None, qx: None, qy: None, qz: None, qw: None })
        };
        let image = |i: usize| (format!("i{i}").parse().unwrap(), at(i as f64 * 10.0));
        Places::new((0..count).map(image).collect())
    }

    fn settings() -> TrackSettings {
        TrackSettings {
            outliers: 0.4,
            jump: 0.05,
            sharpness: 1.5,
            odometry_error: 0.1,
            states: 64,
            max: 1,
            idle_s: 1,
            max_speed_m_s: 1.0,
            candidates: 1,
            known_probability: 0.5,
        }
    }

    fn total(belief: &Belief) -> f64 {
        belief.elsewhere + belief.likely.iter().map(|(_, p)| p).sum::<f64>()
    }

    /// What is written at the top, with every image in its place.
    fn plainly(
        before: &[f64],
        motion: Option<Motion>,
        similarities: &[f32],
        gap: f32,
        settings: &TrackSettings,
    ) -> Vec<f64> {
        let n = before.len();
        let mut moved = before.to_vec();
        if let Some(motion) = motion {
            moved = vec![settings.jump / n as f64; n];
            for (i, held) in before.iter().enumerate() {
                let weight = |j: usize| {
                    let d = 10.0 * i.abs_diff(j) as f64;
                    let off = match motion {
                        Motion::Within(reach) => (d - reach).max(0.0) / 5.0,
                        Motion::By(way) => (d - way) / (5.0 + settings.odometry_error * way),
                    };
                    if off.abs() > TAIL { 0.0 } else { (-0.5 * off * off).exp() }
                };
                let sum: f64 = (0..n).map(weight).sum();
                for (j, part) in moved.iter_mut().enumerate() {
                    *part += (1.0 - settings.jump) * held * weight(j) / sum;
                }
            }
        }
        let first = similarities.iter().copied().fold(f32::MIN, f32::max);
        let e: Vec<f64> = similarities
            .iter()
            .map(|s| f64::from(settings.sharpness as f32 * (s - first) / gap).exp())
            .collect();
        let mean = e.iter().sum::<f64>() / n as f64;
        let product: Vec<f64> = (0..n)
            .map(|j| moved[j] * (settings.outliers + (1.0 - settings.outliers) * e[j] / mean))
            .collect();
        let sum: f64 = product.iter().sum();
        product.iter().map(|p| p / sum).collect()
    }

    #[test]
    fn the_filter_is_the_formula() {
        let (places, settings) = (road(20), settings());
        let similarity = |seed: usize| -> Vec<f32> {
            (0..20).map(|i| 0.5 + ((i * 7 + seed * 3) % 11) as f32 / 40.0).collect()
        };
        let mut belief = Belief::anywhere();
        let mut expected = vec![1.0 / 20.0; 20];
        for (seed, motion) in
            [None, Some(Motion::Within(12.0)), Some(Motion::By(20.0)), Some(Motion::Within(0.0))]
                .into_iter()
                .enumerate()
        {
            let similarities = similarity(seed);
            expected = plainly(&expected, motion, &similarities, 0.05, &settings);
            if let Some(motion) = motion {
                belief = belief.after(motion, &places, &settings);
                assert!((total(&belief) - 1.0).abs() < 1e-9);
            }
            let numbered: Vec<(u32, f32)> = (0..).zip(similarities).collect();
            belief = belief.given(&numbered, 0.05, &places, &settings);
            for (image, probability) in &belief.likely {
                let wanted = expected[*image as usize];
                assert!(
                    (probability - wanted).abs() < 1e-6,
                    "{seed} {image} {probability} {wanted}"
                );
            }
        }
        assert!((total(&belief) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn one_frame_that_lies_does_not_outvote_the_way() {
        let (places, settings) = (road(100), settings());
        let mut belief = Belief::anywhere();
        for at in 10..16 {
            belief = belief.after(Motion::Within(15.0), &places, &settings);
            belief = belief.given(&[(at, 0.9), (50, 0.8), (70, 0.79)], 0.05, &places, &settings);
        }
        assert_eq!(belief.best(&places, 15.0).unwrap().0, 15);
        belief = belief.after(Motion::Within(15.0), &places, &settings);
        let lied = belief.given(&[(80, 0.95), (50, 0.8), (70, 0.79)], 0.05, &places, &settings);
        let (best, probability) = lied.best(&places, 15.0).unwrap();
        assert!((14..=17).contains(&best), "{best} {probability}");
        // Three in a row are a robot that was carried away.
        let mut carried = lied;
        for _ in 0..3 {
            carried = carried.after(Motion::Within(15.0), &places, &settings);
            carried = carried.given(&[(80, 0.95), (50, 0.8), (70, 0.79)], 0.05, &places, &settings);
        }
        let (best, probability) = carried.best(&places, 15.0).unwrap();
        assert_eq!(best, 80);
        assert!(probability > 0.5, "{probability}");
    }

    #[test]
    fn odometry_tells_two_places_apart_that_look_alike() {
        let (places, settings) = (road(60), settings());
        let alike = [(20, 0.9), (40, 0.9), (3, 0.7)];
        let start = Belief::anywhere().given(&[(10, 0.9), (3, 0.7)], 0.05, &places, &settings);
        let moved = start.after(Motion::By(300.0), &places, &settings);
        let moved = moved.given(&alike, 0.05, &places, &settings);
        assert_eq!(moved.best(&places, 5.0).unwrap().0, 40);
    }

    #[test]
    fn a_way_that_leads_nowhere_leaves_the_robot_anywhere() {
        let (places, settings) = (road(20), settings());
        let start = Belief::anywhere().given(&[(0, 0.9), (10, 0.7)], 0.05, &places, &settings);
        let lost = start.after(Motion::By(900.0), &places, &settings);
        assert_eq!(lost.likely, []);
        assert!((lost.elsewhere - 1.0).abs() < 1e-9);
    }

    #[test]
    fn memory_is_bounded_and_nothing_is_lost() {
        let (places, settings) = (road(500), TrackSettings { states: 10, ..settings() });
        let similarities: Vec<(u32, f32)> =
            (0..200).map(|image| (image, 0.5 + image as f32 / 1000.0)).collect();
        let belief = Belief::anywhere().given(&similarities, 0.05, &places, &settings);
        assert_eq!(belief.likely.len(), 10);
        assert!((total(&belief) - 1.0).abs() < 1e-9);
        assert_eq!(belief.best(&places, 1.0).unwrap().0, 199);
        let far = belief.after(Motion::Within(1e7), &places, &settings);
        assert!((total(&far) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_belief_outlives_a_change_of_the_map_and_an_image_that_is_gone_is_nowhere() {
        let (places, settings) = (road(20), settings());
        let belief = Belief::anywhere().given(&[(5, 0.9), (6, 0.85)], 0.05, &places, &settings);
        let (named, more) = (belief.named(&places), road(30));
        assert_eq!(Belief::remembered(&named, &more).best(&more, 1.0).unwrap().0, 5);
        let less = Belief::remembered(&named, &road(6)).without(5);
        assert_eq!(less.best(&places, 1.0), None);
        assert!((total(&less) - 1.0).abs() < 1e-9);
        assert_eq!(belief.without(5).best(&places, 1.0).unwrap().0, 6);
    }
}
