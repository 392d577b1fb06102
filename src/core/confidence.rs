//! How sure an answer is, measured against the map itself.
//!
//! Some of the map's own images are asked as if they were frames, with the images of their own place
//! left out. Whatever answers them is wrong, and only as good as chance resemblance makes it in this
//! map. The [`Evidence`] for the first answer to a frame is held against those: its confidence is the
//! share of them that it exceeds,
//!
//! > c = #{x < e} / (n + 1)
//!
//! for evidence e and n chance values x. This is one less the conformal p-value of the frame
//! (Vovk, Gammerman and Shafer, *Algorithmic Learning in a Random World*, 2005): of frames that show no
//! place of the map, and are otherwise like its images, at most a share of 1 − c reach a confidence
//! of c. Nothing is assumed about the distribution, and no frame needs a ground truth.
//!
//! Evidence is relative to the other candidates of the same frame. A frame at night is less similar
//! to every image of the map, the right one and the wrong ones.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Candidate, ImageId, Pose};

/// Candidates that the similarity of one is compared with, itself included.
pub const COMPARED: usize = 10;

/// What speaks for a candidate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Evidence {
    /// By how much its similarity exceeds the median of the other candidates'.
    Similarity(f32),
    /// ln((a + 1) / (m + 1)) for a regions that agree with the frame, and a median of m that do among the
    /// other candidates.
    Agreement(f32),
}

impl Evidence {
    /// What the similarities of the first [`COMPARED`] candidates say for one of them; `None` for one
    /// that is not among them, and where there is no other.
    pub fn similarity(candidates: &[Candidate], of: &ImageId) -> Option<Self> {
        let compared = &candidates[..candidates.len().min(COMPARED)];
        let one = compared.iter().find(|candidate| candidate.image_id == *of)?;
        let others = compared.iter().filter(|candidate| candidate.image_id != *of);
        let median = median(others.map(|candidate| candidate.similarity).collect())?;
        Some(Self::Similarity(one.similarity - median))
    }

    /// What the numbers of agreeing regions of all candidates say for the one at `of`; `None` where
    /// there is no other.
    pub fn agreement(agreeing: &[usize], of: usize) -> Option<Self> {
        let one = *agreeing.get(of)?;
        let others = agreeing.iter().enumerate().filter(|(index, _)| *index != of);
        let median = median(others.map(|(_, &agreeing)| agreeing as f32).collect())?;
        Some(Self::Agreement(((one as f32 + 1.0) / (median + 1.0)).ln()))
    }
}

/// The middle value, or the mean of the two in the middle; `None` of nothing.
fn median(mut values: Vec<f32>) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    let (low, high) =
        (values.get(values.len().checked_sub(1)? / 2)?, values.get(values.len() / 2)?);
    Some((low + high) / 2.0)
}

/// Evidence that chance gave to wrong answers, in ascending order.
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
    fn from(chance: NullDistribution) -> Self {
        chance.0
    }
}

impl NullDistribution {
    /// How many wrong answers it was measured with.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether nothing was measured.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Their mean; `None` of nothing.
    pub fn mean(&self) -> Option<f32> {
        let sum: f32 = self.0.iter().sum();
        (!self.is_empty()).then(|| sum / self.len() as f32)
    }

    /// c = #{x < e} / (n + 1), 0 to below 1.
    fn confidence(&self, evidence: f32) -> f32 {
        let below = self.0.partition_point(|value| *value < evidence);
        below as f32 / (self.len() + 1) as f32
    }
}

/// What chance resemblance looks like in one map.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Calibration {
    /// Images that the map had when it was measured.
    pub images: usize,
    /// The settings it was measured with.
    pub settings: CalibrationSettings,
    /// Whether all of it was measured; else that was broken off, or goes on.
    pub complete: bool,
    /// Of [`Evidence::Similarity`].
    pub similarity: NullDistribution,
    /// Of [`Evidence::Agreement`]; empty until it is measured, and where there is no refiner.
    pub agreement: NullDistribution,
}

/// How a map is measured.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibrationSettings {
    /// Images that are asked as if they were frames, at most.
    pub images: usize,
    /// Of these, how many are also refined.
    pub refined: usize,
    /// Candidates of a job.
    pub candidates: usize,
    /// An image shows the place of those that were added up to so many before or after it; less in a
    /// map of less than ten times as many images.
    pub place_images: usize,
    /// And of those whose pose is so close, in metres.
    pub place_m: f64,
}

impl CalibrationSettings {
    /// Images on either side that show the same place, in a map of so many.
    pub fn place_radius(&self, images: usize) -> usize {
        self.place_images.min(images / 10)
    }

    /// One of so many images is asked, in a map of so many.
    pub fn step(&self, images: usize) -> usize {
        images.div_ceil(self.images.max(1)).max(1)
    }

    /// Whether two images show different places, in a map of so many. Of each, where it stands in the order
    /// of addition, and its pose.
    pub fn are_apart(
        &self,
        images: usize,
        one: (usize, Option<Pose>),
        other: (usize, Option<Pose>),
    ) -> bool {
        let distance = one.1.zip(other.1).and_then(|(a, b)| a.distance_m(&b));
        one.0.abs_diff(other.0) > self.place_radius(images)
            && distance.is_none_or(|distance| distance > self.place_m)
    }
}

impl Calibration {
    /// The confidence in one of the candidates of a frame: by what the refiner found, if it found
    /// something and that was measured, else by similarity.
    pub fn refined_confidence(
        &self,
        candidates: &[Candidate],
        of: &ImageId,
        found: Option<Evidence>,
    ) -> f32 {
        let found = found.filter(|_| !self.agreement.is_empty());
        let evidence = found.or_else(|| Evidence::similarity(candidates, of));
        evidence.map_or(0.0, |evidence| self.confidence(evidence))
    }

    /// The confidence in an answer for which this speaks, 0 to below 1; 0 where nothing was measured.
    pub fn confidence(&self, evidence: Evidence) -> f32 {
        match evidence {
            Evidence::Similarity(value) => self.similarity.confidence(value),
            Evidence::Agreement(value) => self.agreement.confidence(value),
        }
    }
}

/// The best guess of where a frame was taken.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Estimate {
    /// The image that shows the place.
    pub image_id: ImageId,
    /// Its pose, if known.
    pub pose: Option<Pose>,
    /// How sure it is, 0 to 1: of frames from outside the map, at most the rest to 1 get so much. It is
    /// measured in the map itself, and 0 until that is done, a moment after images were added.
    pub confidence: f32,
    /// Whether the confidence reaches the configured bound, below which the place is perhaps not in
    /// the map.
    pub known: bool,
}

impl Estimate {
    /// The guess that this image shows the place; known from a confidence of `known_from` on.
    pub fn new(image_id: &ImageId, pose: Option<Pose>, confidence: f32, known_from: f64) -> Self {
        let known = f64::from(confidence) >= known_from;
        Self { image_id: image_id.clone(), pose, confidence, known }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidates(similarities: &[f32]) -> Vec<Candidate> {
        let one = |(index, &similarity): (usize, &f32)| Candidate {
            rank: index + 1,
            image_id: index.to_string().parse().unwrap(),
            similarity,
            pose: None,
        };
        similarities.iter().enumerate().map(one).collect()
    }

    #[test]
    fn similarity_speaks_for_one_against_the_median_of_the_first_ten() {
        let some = candidates(&[0.9, 0.5, 0.4, 0.1]);
        let of = |index: &str| Evidence::similarity(&some, &index.parse().unwrap());
        assert_eq!(of("0"), Some(Evidence::Similarity(0.9 - 0.4)));
        assert_eq!(of("2"), Some(Evidence::Similarity(0.4 - 0.5)));
        assert_eq!(of("7"), None);
        assert_eq!(Evidence::similarity(&some[..1], &"0".parse().unwrap()), None);
        let many = candidates(&[&[0.75][..], &[0.5; 9], &[0.0; 90]].concat());
        let first = Evidence::similarity(&many, &"0".parse().unwrap());
        assert_eq!(first, Some(Evidence::Similarity(0.25)));
    }

    #[test]
    fn agreement_speaks_for_one_by_the_ratio_to_the_median_of_the_others() {
        let Some(Evidence::Agreement(ratio)) = Evidence::agreement(&[3, 39, 1, 1, 5], 1) else {
            panic!("there are others")
        };
        assert!((ratio - (40.0_f32 / 3.0).ln()).abs() < 1e-6);
        assert_eq!(Evidence::agreement(&[3], 0), None);
        assert_eq!(Evidence::agreement(&[3, 4], 2), None);
    }

    #[test]
    fn of_chance_values_at_most_their_share_is_as_sure() {
        let chance = NullDistribution::from(vec![0.3, 0.1, 0.2, 0.2]);
        let of = |evidence| chance.confidence(evidence);
        assert_eq!([of(0.05), of(0.2), of(0.25), of(9.0)], [0.0, 0.2, 0.6, 0.8]);
        // Each of 99 values, held against the other 98.
        let values: Vec<f32> = (0..99).map(|i| ((i * 37) % 99) as f32).collect();
        let sure = (0..99).filter(|&left_out| {
            let mut others = values.clone();
            let one = others.remove(left_out);
            NullDistribution::from(others).confidence(one) >= 0.9
        });
        assert!(sure.count() <= 10);
        assert_eq!(NullDistribution::default().confidence(1.0), 0.0);
    }

    #[test]
    fn a_small_map_has_small_places() {
        let settings = CalibrationSettings { place_images: 4, ..Default::default() };
        assert_eq!([8, 25, 40, 4000].map(|n| settings.place_radius(n)), [0, 2, 4, 4]);
    }
}
