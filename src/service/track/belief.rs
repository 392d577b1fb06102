//! A discrete Bayes filter over the images of a map (Thrun, Burgard and Fox, *Probabilistic Robotics*,
//! 2005, chapter 4): where a robot is, given all its frames so far.
//!
//! Every frame takes two steps. *Predict*: for images i and j of the map,
//!
//! > p′(j) = (1 − ε) Σ p(i) T(i → j) + ε / N
//!
//! where T falls off as a Gaussian beyond the distance that the robot can have moved, or around the distance
//! of its odometry, and ε is the probability that it was carried anywhere. *Update*:
//!
//! > p(j) ∝ p′(j) · (ω + (1 − ω) e(j) / ē),  e(j) = exp(β (s(j) − s₁) / g)
//!
//! with the similarity s(j) of the frame and the image, s₁ the highest, ē the mean of e over all images,
//! and g the gap expected by chance between the first wrong answer and the median of the next ones, which is
//! measured in the map ([`Evidence`](whereabouts_core::Evidence)). ω is the share of outliers, frames without
//! information because, for example, a bus blocks the camera; it bounds the weight of a single frame.
//!
//! Only the most likely images are kept; the rest of the probability is spread evenly over the map.

use super::TrackSettings;
use super::places::Places;
use whereabouts_core::ImageId;

/// A Gaussian is cut off beyond this many standard deviations.
const TAIL: f64 = 3.0;

/// Maximum number of images that a robot may have moved to from one image; if more are in reach, the probability
/// is spread over the whole map.
const MAX_REACHED: usize = 512;

/// How far a robot has moved since its last frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Motion {
    /// At most this many metres.
    Within(f64),
    /// This many metres, by its odometry.
    By(f64),
}

/// A probability distribution over the images of a map.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Belief {
    /// The most likely images by number, in ascending order, each with its probability in addition to its share
    /// of `elsewhere`.
    likely: Vec<(u32, f64)>,
    /// The probability that is spread evenly over all images.
    elsewhere: f64,
}

impl Belief {
    /// The uniform distribution, before the first frame.
    pub fn uniform() -> Self {
        Self { likely: Vec::new(), elsewhere: 1.0 }
    }

    /// The prediction step: the belief after the robot has moved.
    pub fn predicted(&self, motion: Motion, places: &Places, settings: &TrackSettings) -> Self {
        let width = places.spacing() / 2.0;
        let (low, high, width) = match motion {
            Motion::Within(reach) => (0.0, reach, width),
            // Odometry drifts, and the path may have been curved.
            Motion::By(distance) => {
                (distance, distance, width + settings.odometry_error * distance)
            }
        };
        let mut moved = Vec::new();
        let mut elsewhere = self.elsewhere;
        for &(image, probability) in &self.likely {
            let reached = places.near(image, high + TAIL * width, MAX_REACHED).unwrap_or_default();
            let weight = |distance: f64| {
                let off = (low - distance).max(distance - high).max(0.0) / width;
                // Cut off, or the normalisation would make the nearest image certain, however far it is.
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

    /// The update step: the belief after a frame. `similarities` are those of the most similar images; every other
    /// image counts as if it had the lowest of them. `gap` is g above.
    pub fn updated(
        &self,
        similarities: &[(u32, f32)],
        gap: f32,
        places: &Places,
        settings: &TrackSettings,
    ) -> Self {
        let count = places.len() as f64;
        let [mut first, mut last] = [f32::NEG_INFINITY, f32::INFINITY];
        for (_, similarity) in similarities {
            first = first.max(*similarity);
            last = last.min(*similarity);
        }
        if similarities.is_empty() || count < 1.0 {
            return self.clone();
        }
        let likelihood_of = |similarity: f32| {
            f64::from(settings.sharpness as f32 * (similarity - first) / gap).exp()
        };
        let rest = likelihood_of(last);
        let sum: f64 = similarities.iter().map(|(_, similarity)| likelihood_of(*similarity)).sum();
        let mean = (sum + (count - similarities.len() as f64).max(0.0) * rest) / count;
        let weight =
            |likelihood: f64| settings.outliers + (1.0 - settings.outliers) * likelihood / mean;

        let share = self.elsewhere / count;
        // Every likely and every similar image, with its prior probability.
        let mut weighed: Vec<(u32, f64)> = self.likely.clone();
        weighed.extend(similarities.iter().map(|(image, _)| (*image, 0.0)));
        let mut weighed = merged(weighed);
        let mut sorted = similarities.to_vec();
        sorted.sort_by_key(|(image, _)| *image);
        for (image, probability) in &mut weighed {
            let found = sorted.binary_search_by_key(image, |(similar, _)| *similar);
            let likelihood = found.map_or(rest, |at| likelihood_of(sorted[at].1));
            *probability = (*probability + share) * weight(likelihood);
        }
        let elsewhere = share * (count - weighed.len() as f64).max(0.0) * weight(rest);
        Self { likely: weighed, elsewhere }.pruned(settings.states)
    }

    /// Keeps the `max` most likely images, moves the rest of the probability elsewhere, and normalises the sum.
    fn pruned(mut self, max: usize) -> Self {
        if self.likely.len() > max {
            self.likely.sort_by(|a, b| b.1.total_cmp(&a.1));
            self.elsewhere += self.likely.drain(max..).map(|(_, p)| p).sum::<f64>();
            self.likely.sort_by_key(|(image, _)| *image);
        }
        let total = self.elsewhere + self.likely.iter().map(|(_, p)| p).sum::<f64>();
        if !total.is_normal() {
            return Self::uniform();
        }
        self.elsewhere /= total;
        self.likely.iter_mut().for_each(|(_, probability)| *probability /= total);
        self
    }

    /// Returns the most likely image, and the probability that the robot is within `radius` metres of it.
    pub fn best(&self, places: &Places, radius: f64) -> Option<(u32, f64)> {
        let (best, _) =
            self.likely.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))?;
        let near = self.likely.iter().filter(|(image, _)| places.distance(*best, *image) <= radius);
        Some((*best, near.map(|(_, probability)| probability).sum()))
    }

    /// Returns the likely images by their ids, which stay valid when the map changes.
    pub fn by_id(&self, places: &Places) -> Vec<(ImageId, f64)> {
        self.likely.iter().map(|(image, p)| (places.id(*image).clone(), *p)).collect()
    }

    /// Restores a belief from [`by_id`](Self::by_id). The probability of images that were deleted is spread over the
    /// map.
    pub fn from_ids(by_id: &[(ImageId, f64)], places: &Places) -> Self {
        let known = by_id.iter().filter_map(|(id, p)| Some((places.number(id)?, *p)));
        let likely = merged(known.collect());
        let elsewhere = (1.0 - likely.iter().map(|(_, p)| p).sum::<f64>()).max(0.0);
        Self { likely, elsewhere }
    }

    /// Removes an image.
    pub fn without(mut self, image: u32) -> Self {
        self.likely.retain(|(other, _)| *other != image);
        let max = self.likely.len();
        self.pruned(max)
    }
}

/// Sorts by image and adds up the probabilities of equal ones.
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
mod tests;
