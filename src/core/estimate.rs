//! The estimate of the place of a frame, and the confidence that it has or will have.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Calibration, Candidate, Evidence, ImageId, Pose};

/// The most likely place of a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Estimate {
    /// Image that shows the place.
    pub image_id: ImageId,
    /// Pose of that image, if known.
    pub pose: Option<Pose>,
    /// Confidence c, 0 to 1: of frames taken outside the map, at most a fraction 1 − c reaches it. Null while it is not
    /// measured yet how convincing a wrong answer is in this map, which happens in the background shortly after images
    /// were added. A job that ended before has its confidence as soon as it is measured.
    #[serde(default)]
    pub confidence: Option<f32>,
    /// Whether the confidence reaches the configured threshold. Below it, the place may not be in the map.
    pub known: bool,
    /// Why the place cannot be known from this frame, whatever it resembles; otherwise null.
    #[serde(default)]
    #[schema(nullable)]
    pub reason: Option<String>,
    /// What the confidence will be computed from, where the similarity of the candidates is not enough. Only while the
    /// confidence is null.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(nullable)]
    pub evidence: Option<Evidence>,
}

impl Estimate {
    /// An estimate that counts as known if its confidence is at least `known_from`.
    pub fn new(
        image_id: &ImageId,
        pose: Option<Pose>,
        confidence: Option<f32>,
        known_from: f64,
    ) -> Self {
        let known = is_known(confidence, known_from);
        Self { image_id: image_id.clone(), pose, confidence, known, reason: None, evidence: None }
    }

    /// The estimate with what its confidence will be computed from, if it has none yet.
    pub fn with_evidence(self, evidence: Option<Evidence>) -> Self {
        Self { evidence: evidence.filter(|_| self.confidence.is_none()), ..self }
    }

    /// The estimate for a frame that shows no place, if `reason` says why: what it resembles is chance, so the
    /// confidence is 0.
    pub fn unless(self, reason: Option<&str>) -> Self {
        match reason {
            Some(reason) => Self {
                confidence: Some(0.0),
                known: false,
                reason: Some(reason.to_owned()),
                evidence: None,
                ..self
            },
            None => self,
        }
    }

    /// Computes a confidence that was not measured when the estimate was made, if it is now. `candidates` are those of
    /// the frame.
    pub fn measure(
        &mut self,
        calibration: &Calibration,
        candidates: &[Candidate],
        known_from: f64,
    ) {
        if self.confidence.is_some() {
            return;
        }
        let confidence = calibration.refined_confidence(candidates, &self.image_id, self.evidence);
        if confidence.is_some() {
            self.confidence = confidence;
            self.known = is_known(confidence, known_from);
            self.evidence = None;
        }
    }
}

fn is_known(confidence: Option<f32>, known_from: f64) -> bool {
    // In the precision of the confidence: 0.9 as f32 is less than 0.9 as f64.
    confidence.is_some_and(|confidence| confidence >= known_from as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::confidence::NullDistribution;

    fn estimate(confidence: Option<f32>) -> Estimate {
        Estimate::new(&"a".parse().unwrap(), None, confidence, 0.9)
    }

    #[test]
    fn an_estimate_is_known_from_its_threshold_in_the_precision_of_the_confidence() {
        assert!(estimate(Some(0.9)).known && !estimate(Some(0.899)).known);
        assert!(!estimate(None).known);
    }

    #[test]
    fn an_estimate_that_was_made_before_the_map_was_calibrated_gets_its_confidence_later() {
        let mut pending = estimate(None).with_evidence(Some(Evidence::Agreement(2.0)));
        let nothing = Calibration::default();
        pending.measure(&nothing, &[], 0.9);
        assert_eq!((pending.confidence, pending.evidence), (None, Some(Evidence::Agreement(2.0))));
        let stored = serde_json::to_string(&pending).unwrap();
        let mut pending: Estimate = serde_json::from_str(&stored).unwrap();
        let agreement = NullDistribution::from(vec![0.0; 99]);
        let measured = Calibration { complete: true, agreement, ..Calibration::default() };
        pending.measure(&measured, &[], 0.9);
        assert_eq!((pending.confidence, pending.known, pending.evidence), (Some(0.99), true, None));
        // What was measured stays as it is.
        let mut known = estimate(Some(0.95));
        known.measure(&measured, &[], 0.9);
        assert_eq!(known, estimate(Some(0.95)));
    }

    #[test]
    fn a_frame_that_shows_nothing_has_a_confidence_of_0_before_the_map_is_calibrated() {
        let blank = estimate(None).with_evidence(Some(Evidence::Agreement(2.0)));
        let blank = blank.unless(Some("it is blank"));
        assert_eq!((blank.confidence, blank.known, blank.evidence), (Some(0.0), false, None));
    }

    #[test]
    fn an_estimate_of_an_earlier_version_can_be_read() {
        let stored = r#"{"image_id": "a", "pose": null, "confidence": 0.5, "known": false}"#;
        let read: Estimate = serde_json::from_str(stored).unwrap();
        assert_eq!(read, estimate(Some(0.5)));
    }
}
