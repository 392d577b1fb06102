//! Confidence of an answer, calibrated on the map itself.
//!
//! Calibration queries the map with a sample of its own images, excluding all images of the same place
//! (hard negatives). Every answer to these queries is wrong, so the [`Evidence`] for them samples the null
//! distribution of this map. The confidence of an answer is the share of the null distribution that its
//! evidence exceeds,
//!
//! > c = #{x < e} / (n + 1)
//!
//! for evidence e and n null values x. This is one minus the conformal p-value of the frame (Vovk,
//! Gammerman and Shafer, *Algorithmic Learning in a Random World*, 2005): of frames that show no place of
//! the map but otherwise resemble its images, at most a fraction 1 − c reaches confidence c. The bound is
//! distribution-free and needs no ground truth.
//!
//! Evidence is relative to the other candidates of the same frame, because conditions such as night lower
//! the similarity to right and wrong images alike.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Candidate, ImageId, Pose};

/// Number of top candidates among which similarities are compared.
pub const COMPARED: usize = 10;

/// Share of a frame's regions that match a picture of another place by chance. It bounds the evidence of small counts:
/// 11 of 1,200 regions against none would otherwise weigh as much as 600 against 50.
pub const CHANCE_SHARE: f32 = 0.02;

/// Evidence that a candidate shows the place of the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Evidence {
    /// Similarity of the candidate minus the median similarity of the other candidates.
    Similarity(f32),
    /// ln((a + c) / (m + c)), where a regions of the candidate match the frame, m is the median of that count over
    /// the other candidates, and c is [`CHANCE_SHARE`] of the regions of the frame.
    Agreement(f32),
    /// The evidence of a model's verdict, see [`Agreement::verdict`](crate::Agreement::verdict).
    Verdict(f32),
    /// The same where the regions put the same candidate first, or nearly: either evidence counts.
    Concurring {
        /// The evidence of the verdict.
        verdict: f32,
        /// The evidence of the regions, as of [`Self::Agreement`].
        agreement: f32,
    },
}

impl Evidence {
    /// The evidence of a verdict that none of the candidates shows the place. Finite, so that it can be stored.
    pub const NONE_OF_THESE: Self = Self::Verdict(f32::MIN);

    /// Computes the evidence for the image `of` from the similarities of the first [`COMPARED`]
    /// candidates. Returns `None` if the image is not among them or is the only one.
    pub fn similarity(candidates: &[Candidate], of: &ImageId) -> Option<Self> {
        let compared = &candidates[..candidates.len().min(COMPARED)];
        let one = compared.iter().find(|candidate| candidate.image_id == *of)?;
        let others = compared.iter().filter(|candidate| candidate.image_id != *of);
        let median = median(others.map(|candidate| candidate.similarity).collect())?;
        Some(Self::Similarity(one.similarity - median))
    }

    /// Computes the evidence for the candidate at index `of` from the number of matching regions of every
    /// candidate, of the `regions` that the frame has. Returns `None` if there is no other candidate.
    pub fn agreement(matches: &[usize], regions: usize, of: usize) -> Option<Self> {
        let one = *matches.get(of)?;
        let others = matches.iter().enumerate().filter(|(index, _)| *index != of);
        let median = median(others.map(|(_, &count)| count as f32).collect())?;
        let chance = chance(regions);
        Some(Self::Agreement(((one as f32 + chance) / (median + chance)).ln()))
    }
}

/// How many of that many regions of a frame match a picture of another place by chance.
pub(super) fn chance(regions: usize) -> f32 {
    (CHANCE_SHARE * regions as f32).max(1.0)
}

/// The median; `None` if `values` is empty.
fn median(mut values: Vec<f32>) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    let (low, high) =
        (values.get(values.len().checked_sub(1)? / 2)?, values.get(values.len() / 2)?);
    Some((low + high) / 2.0)
}

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
    fn confidence(&self, evidence: f32) -> f32 {
        let below = self.0.partition_point(|value| *value < evidence);
        below as f32 / (self.len() + 1) as f32
    }
}

/// Null distributions of one map.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Calibration {
    /// Number of images in the map when it was calibrated.
    pub images: usize,
    /// How often poses of the map's images had been changed when it was calibrated.
    #[serde(default)]
    pub moved: u64,
    /// Settings of the calibration.
    pub settings: CalibrationSettings,
    /// Version of the definition of the evidence. A calibration by another definition is measured again.
    #[serde(default)]
    pub evidence: u32,
    /// Whether the calibration is complete; `false` while it is running or after it was interrupted.
    pub complete: bool,
    /// Null distribution of [`Evidence::Similarity`].
    pub similarity: NullDistribution,
    /// Null distribution of [`Evidence::Agreement`]; empty without a refiner or until it is measured.
    pub agreement: NullDistribution,
    /// Null distribution of [`Evidence::Verdict`]. Unless the model was asked, it is that of a model that is certain of
    /// whichever wrong image agrees most, so that no model can do worse.
    #[serde(default)]
    pub verdict: NullDistribution,
    /// Number of images about which the model was asked for that; 0 if it was not.
    #[serde(default)]
    pub model_asked: usize,
}

/// How a map is calibrated.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibrationSettings {
    /// Maximum number of images used as queries.
    pub images: usize,
    /// Number of these queries that are also refined.
    pub refined: usize,
    /// Candidates per job.
    pub candidates: usize,
    /// Images added within this distance, in order of addition, count as the same place. Reduced in maps
    /// with fewer than ten times as many images.
    pub place_images: usize,
    /// Images whose poses are within this many metres count as the same place.
    pub place_m: f64,
    /// Maximum number of calls to a paid model; 0 for none.
    #[serde(default)]
    pub model_calls: usize,
}

impl CalibrationSettings {
    /// How many images before and after an image count as the same place, in a map with `images` images.
    pub fn place_radius(&self, images: usize) -> usize {
        self.place_images.min(images / 10)
    }

    /// Stride at which a map with `images` images is sampled.
    pub fn step(&self, images: usize) -> usize {
        images.div_ceil(self.images.max(1)).max(1)
    }

    /// Whether two images of a map with `images` images show different places. Each is given by its index
    /// in order of addition and its pose.
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
    /// The present definition of [`Evidence`].
    pub const EVIDENCE: u32 = 2;

    /// Confidence that the image `of` shows the place of the frame. Uses the evidence of the refiner if
    /// there is any and its kind is calibrated, and similarity otherwise.
    pub fn refined_confidence(
        &self,
        candidates: &[Candidate],
        of: &ImageId,
        refined: Option<Evidence>,
    ) -> f32 {
        if refined == Some(Evidence::NONE_OF_THESE) {
            return 0.0;
        }
        let refined = refined.and_then(|evidence| self.calibrated(evidence));
        let similarity = || Evidence::similarity(candidates, of).map(|one| self.confidence(one));
        refined.or_else(similarity).unwrap_or_default()
    }

    /// Confidence of an answer with this evidence, in [0, 1); 0 in a map that is not calibrated.
    pub fn confidence(&self, evidence: Evidence) -> f32 {
        self.calibrated(evidence).unwrap_or_default()
    }

    /// The same; `None` if evidence of its kind is not calibrated.
    fn calibrated(&self, evidence: Evidence) -> Option<f32> {
        let of =
            |null: &NullDistribution, value| (!null.is_empty()).then(|| null.confidence(value));
        match evidence {
            Evidence::Similarity(value) => of(&self.similarity, value),
            Evidence::Agreement(value) => of(&self.agreement, value),
            Evidence::Verdict(value) => of(&self.verdict, value),
            Evidence::Concurring { verdict, agreement } => {
                let verdict = of(&self.verdict, verdict);
                let agreement = of(&self.agreement, agreement);
                verdict.into_iter().chain(agreement).reduce(f32::max)
            }
        }
    }
}

/// The most likely place of a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Estimate {
    /// Image that shows the place.
    pub image_id: ImageId,
    /// Pose of that image, if known.
    pub pose: Option<Pose>,
    /// Confidence c, 0 to 1: of frames taken outside the map, at most a fraction 1 − c reaches it. It is
    /// calibrated on the map itself and 0 until calibration has run, shortly after images were added.
    pub confidence: f32,
    /// Whether the confidence reaches the configured threshold. Below it, the place may not be in the map.
    pub known: bool,
    /// Why the place cannot be known from this frame, whatever it resembles; otherwise null.
    #[serde(default)]
    #[schema(nullable)]
    pub reason: Option<String>,
}

impl Estimate {
    /// An estimate that counts as known if its confidence is at least `known_from`.
    pub fn new(image_id: &ImageId, pose: Option<Pose>, confidence: f32, known_from: f64) -> Self {
        // In the precision of the confidence: 0.9 as f32 is less than 0.9 as f64.
        let known = confidence >= known_from as f32;
        Self { image_id: image_id.clone(), pose, confidence, known, reason: None }
    }

    /// The estimate for a frame that shows no place, if `reason` says why: what it resembles is chance, so the
    /// confidence is 0.
    pub fn unless(self, reason: Option<&str>) -> Self {
        match reason {
            Some(reason) => {
                Self { confidence: 0.0, known: false, reason: Some(reason.to_owned()), ..self }
            }
            None => self,
        }
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
    fn similarity_evidence_is_relative_to_the_median_of_the_first_ten() {
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
    fn agreement_evidence_is_the_log_ratio_to_the_median_of_the_others() {
        let ratio = |matches: &[usize], regions| match Evidence::agreement(matches, regions, 1) {
            Some(Evidence::Agreement(ratio)) => ratio,
            other => panic!("{other:?}"),
        };
        assert!((ratio(&[3, 39, 1, 1, 5], 20) - (40.0_f32 / 3.0).ln()).abs() < 1e-6);
        assert_eq!(Evidence::agreement(&[3], 20, 0), None);
        assert_eq!(Evidence::agreement(&[3, 4], 20, 2), None);
        // A few regions against none are less than many against some.
        assert!(ratio(&[0, 11, 0], 1200) < 0.5 && ratio(&[50, 600, 50], 1200) > 2.0);
    }

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

    #[test]
    fn a_model_that_says_none_of_these_makes_nothing_known() {
        let some = candidates(&[0.9, 0.1, 0.1]);
        let null = NullDistribution::from(vec![0.0; 99]);
        let similarity = null.clone();
        let calibration = Calibration { similarity, verdict: null, ..Calibration::default() };
        let of =
            |refined| calibration.refined_confidence(&some, &"0".parse().unwrap(), Some(refined));
        assert_eq!(of(Evidence::Verdict(1.0)), 0.99);
        assert_eq!(of(Evidence::NONE_OF_THESE), 0.0);
        // What is not calibrated is not used: the similarity decides.
        assert_eq!(of(Evidence::Agreement(-5.0)), 0.99);
        let agreement = NullDistribution::from(vec![5.0; 99]);
        let both = Calibration { agreement, ..calibration.clone() };
        let concurring = |agreement| Evidence::Concurring { verdict: 1.0, agreement };
        assert_eq!(both.confidence(concurring(0.0)), 0.99);
        assert_eq!(both.confidence(Evidence::Concurring { verdict: -1.0, agreement: 6.0 }), 0.99);
        assert_eq!(both.confidence(Evidence::Concurring { verdict: -1.0, agreement: 4.0 }), 0.0);
        let stored = serde_json::to_string(&NullDistribution::from(vec![f32::MIN, 1.0])).unwrap();
        let read: NullDistribution = serde_json::from_str(&stored).unwrap();
        assert_eq!(read, NullDistribution::from(vec![f32::MIN, 1.0]));
    }

    #[test]
    fn the_place_radius_shrinks_in_a_small_map() {
        let settings = CalibrationSettings { place_images: 4, ..Default::default() };
        assert_eq!([8, 25, 40, 4000].map(|n| settings.place_radius(n)), [0, 2, 4, 4]);
    }
}
