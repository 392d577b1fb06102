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
//! The bound holds on average over maps. The confidence of an answer at once holds it for nine maps in ten
//! ([`NullDistribution`]), because a null distribution of few images is itself a sample.
//!
//! Evidence is relative to the other candidates of the same frame, because conditions such as night lower
//! the similarity to right and wrong images alike.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use super::null_distribution::NullDistribution;
use super::resemblance;
pub use super::resemblance::{COMPARED, neighbour_weights};
use super::{Candidate, ImageId, Pose};

/// Share of a frame's regions that match a picture of another place by chance.
pub const CHANCE_SHARE: f32 = 0.02;

/// Share of a frame's regions that is added to both counts of a comparison. It bounds the evidence of small counts: 60 of
/// 1,200 regions against 20, as a test card has, would otherwise weigh as much as 600 against 200. Right answers have a
/// quarter of the regions or more.
pub const SUPPORT_SHARE: f32 = 0.08;

/// Evidence that a candidate shows the place of the frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Evidence {
    /// ln((a + c) / (m + c)), where a is how similar the candidate and its neighbours are to the frame, m the median of
    /// that over the candidates of other places, and c is 0.1.
    Similarity(f32),
    /// ln((a + c) / (m + c)), where a regions of the candidate match the frame, m is the mean of the two largest counts
    /// among the candidates of other places, and c is [`SUPPORT_SHARE`] of the regions of the frame. See
    /// [`Agreement::evidence`](crate::Agreement::evidence).
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
}

/// How many of that many regions of a frame match a picture of another place by chance.
pub fn chance(regions: usize) -> f32 {
    (CHANCE_SHARE * regions as f32).max(1.0)
}

/// How many regions are added to the counts of a comparison.
pub(super) fn support(regions: usize) -> f32 {
    (SUPPORT_SHARE * regions as f32).max(1.0)
}

/// Null distributions of one map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
    /// What an image has in common with the one that was added 1, 2, … images later; see [`neighbour_weights`].
    #[serde(default)]
    pub neighbours: Vec<f32>,
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

impl Default for Calibration {
    /// Nothing is measured.
    fn default() -> Self {
        Self {
            images: 0,
            moved: 0,
            settings: CalibrationSettings::default(),
            evidence: Self::EVIDENCE,
            complete: false,
            similarity: NullDistribution::default(),
            neighbours: Vec::new(),
            agreement: NullDistribution::default(),
            verdict: NullDistribution::default(),
            model_asked: 0,
        }
    }
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
        one.0.abs_diff(other.0) > self.place_radius(images) && self.are_distant(one.1, other.1)
    }

    /// Whether two poses are too far apart for one place, as far as both are known.
    pub(super) fn are_distant(&self, one: Option<Pose>, other: Option<Pose>) -> bool {
        let distance = one.zip(other).and_then(|(one, other)| one.distance_m(&other));
        distance.is_none_or(|distance| distance > self.place_m)
    }
}

impl Calibration {
    /// The present definition of [`Evidence`].
    pub const EVIDENCE: u32 = 4;

    /// Confidence that the image `of` shows the place of the frame, in [0, 1). Uses the evidence of the refiner if there
    /// is any and its kind is calibrated, and similarity otherwise. `None` while it is not measured yet.
    pub fn refined_confidence(
        &self,
        candidates: &[Candidate],
        of: &ImageId,
        refined: Option<Evidence>,
    ) -> Option<f32> {
        match refined {
            Some(Evidence::NONE_OF_THESE) => return Some(0.0),
            Some(evidence) => match self.confidence(evidence) {
                Some(confidence) => return Some(confidence),
                // It may be measured after the similarity.
                None if !self.complete => return None,
                None => {}
            },
            None => {}
        }
        let measured = |evidence| self.confidence(evidence);
        // A complete calibration of a map that is too small says nothing, and so does a single candidate.
        let of_similarity = self.similarity_evidence(candidates, of).and_then(measured);
        of_similarity.or((self.is_current() && self.complete).then_some(0.0))
    }

    /// Returns the evidence for the image `of` by the similarities of the first [`COMPARED`] candidates; `None` if the image
    /// is not among them or is the only one.
    pub fn similarity_evidence(&self, candidates: &[Candidate], of: &ImageId) -> Option<Evidence> {
        let map = (self.images, &self.settings);
        resemblance::evidence(candidates, of, map, &self.neighbours).map(Evidence::Similarity)
    }

    /// Returns the share of the null distribution that the evidence of the first candidate exceeds: its confidence without
    /// the margin for the size of the sample. For uses that add up many frames. `None` while it is not measured.
    pub fn exceeded(&self, candidates: &[Candidate]) -> Option<f32> {
        match self.similarity_evidence(candidates, &candidates.first()?.image_id)? {
            Evidence::Similarity(value) if self.is_current() && !self.similarity.is_empty() => {
                Some(self.similarity.confidence(value))
            }
            _ => None,
        }
    }

    /// Whether it is by the present definition of the evidence.
    fn is_current(&self) -> bool {
        self.evidence == Self::EVIDENCE
    }

    /// Confidence of an answer with this evidence, in [0, 1); `None` if evidence of its kind is not calibrated.
    pub fn confidence(&self, evidence: Evidence) -> Option<f32> {
        if !self.is_current() {
            return None;
        }
        let of =
            |null: &NullDistribution, value| (!null.is_empty()).then(|| null.confidence(value));
        match evidence {
            Evidence::Similarity(value) => {
                let null = &self.similarity;
                (!null.is_empty()).then(|| null.assured_confidence(value))
            }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn candidates(similarities: &[f32]) -> Vec<Candidate> {
        let one = |(index, &similarity): (usize, &f32)| Candidate {
            rank: index + 1,
            image_id: index.to_string().parse().unwrap(),
            similarity,
            pose: None,
            order: None,
        };
        similarities.iter().enumerate().map(one).collect()
    }

    #[test]
    fn a_model_that_says_none_of_these_makes_nothing_known() {
        let some = candidates(&[0.9, 0.1, 0.1]);
        let assured = NullDistribution::from(vec![0.0; 99]).assured_confidence(1.0);
        let null = NullDistribution::from(vec![0.0; 99]);
        let similarity = null.clone();
        let calibration = Calibration { similarity, verdict: null, ..Calibration::default() };
        let of =
            |refined| calibration.refined_confidence(&some, &"0".parse().unwrap(), Some(refined));
        assert_eq!(of(Evidence::Verdict(1.0)), Some(0.99));
        assert_eq!(of(Evidence::NONE_OF_THESE), Some(0.0));
        // What is never calibrated is not used: the similarity decides. Until then it is open.
        assert_eq!(of(Evidence::Agreement(-5.0)), None);
        let complete = Calibration { complete: true, ..calibration.clone() };
        let refined = Some(Evidence::Agreement(-5.0));
        let by_similarity = complete.refined_confidence(&some, &"0".parse().unwrap(), refined);
        assert_eq!(by_similarity, Some(assured));
        let agreement = NullDistribution::from(vec![5.0; 99]);
        let both = Calibration { agreement, ..calibration.clone() };
        let concurring = |agreement| Evidence::Concurring { verdict: 1.0, agreement };
        assert_eq!(both.confidence(concurring(0.0)), Some(0.99));
        assert_eq!(
            both.confidence(Evidence::Concurring { verdict: -1.0, agreement: 6.0 }),
            Some(0.99)
        );
        assert_eq!(
            both.confidence(Evidence::Concurring { verdict: -1.0, agreement: 4.0 }),
            Some(0.0)
        );
        let stored = serde_json::to_string(&NullDistribution::from(vec![f32::MIN, 1.0])).unwrap();
        let read: NullDistribution = serde_json::from_str(&stored).unwrap();
        assert_eq!(read, NullDistribution::from(vec![f32::MIN, 1.0]));
    }

    #[test]
    fn what_is_not_measured_is_none_and_what_was_measured_by_another_definition_too() {
        let some = candidates(&[0.9, 0.1, 0.1]);
        let first = "0".parse().unwrap();
        let of = |calibration: &Calibration| calibration.refined_confidence(&some, &first, None);
        assert_eq!(of(&Calibration::default()), None);
        let similarity = NullDistribution::from(vec![0.0; 99]);
        let measured = Calibration { similarity, ..Calibration::default() };
        assert!((of(&measured).unwrap() - 0.977).abs() < 1e-3, "{:?}", of(&measured));
        // Without the margin for the size of the sample.
        assert_eq!(measured.exceeded(&some), Some(0.99));
        assert_eq!(Calibration::default().exceeded(&some), None);
        assert_eq!(of(&Calibration { evidence: Calibration::EVIDENCE - 1, ..measured }), None);
        // Nothing can be measured in a map without hard negatives.
        assert_eq!(of(&Calibration { complete: true, ..Calibration::default() }), Some(0.0));
    }

    #[test]
    fn the_place_radius_shrinks_in_a_small_map() {
        let settings = CalibrationSettings { place_images: 4, ..Default::default() };
        assert_eq!([8, 25, 40, 4000].map(|n| settings.place_radius(n)), [0, 2, 4, 4]);
    }
}
