//! Whether the answer of `local` stands, and if not, which candidates are in question. A pure function of what
//! `local` found and of the calibration of the map.

use serde::{Deserialize, Serialize};
use whereabouts_core::{Agreement, Calibration, Candidate, Evidence, Pose};

/// `[cascade]`
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CascadeSettings {
    /// Confidence of `local` from which its answer stands.
    pub stop_confidence: f64,
    /// The answer is in question, whatever its confidence, if a candidate of another place agrees with the frame in
    /// more than this share of the regions in which the first does.
    pub close: f64,
    /// Maximum number of candidates about which the model is asked.
    pub candidates: usize,
}

impl CascadeSettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        let is_share = |value: f64| (0.0..=1.0).contains(&value);
        if !is_share(self.stop_confidence) || !is_share(self.close) {
            return Some("cascade.stop_confidence and cascade.close must be 0 to 1".into());
        }
        (self.candidates < 2).then(|| "cascade.candidates must be at least 2".into())
    }
}

/// What `local` found about one frame.
pub struct LocalFinding<'a> {
    /// The candidates in coarse order.
    pub candidates: &'a [Candidate],
    /// The indices of the candidates, as `local` ranks them.
    pub order: &'a [usize],
    /// How far the regions of the frame and each candidate agree.
    pub agreement: &'a Agreement,
    /// The evidence for the first.
    pub evidence: Option<Evidence>,
}

/// Whether the answer of `local` stands.
#[derive(Debug, Clone, PartialEq)]
pub enum Question {
    /// It does.
    Settled {
        /// Why.
        why: String,
    },
    /// It does not.
    Open {
        /// Why.
        why: String,
        /// The indices of the candidates in question, in coarse order.
        candidates: Vec<usize>,
    },
}

/// Decides whether the answer of `local` stands.
///
/// In a map that is not calibrated, or in which no answer can reach the wanted confidence because it has too few images,
/// only a close second puts the answer in question: the confidence says nothing there, and would buy a verdict on every
/// frame.
pub fn question(
    settings: &CascadeSettings,
    calibration: &Calibration,
    found: &LocalFinding<'_>,
) -> Question {
    let open = |why: String| Question::Open { why, candidates: in_question(settings, found.order) };
    let Some(&first) = found.order.first() else {
        return Question::Settled { why: "there is no candidate".into() };
    };
    if found.candidates.len() < 2 {
        return Question::Settled { why: "there is one candidate only".into() };
    }
    // In the precision of the confidence: 0.9 as f32 is less than 0.9 as f64.
    let bound = settings.stop_confidence as f32;
    let reachable = calibration.agreement.highest_confidence();
    let is_calibrated = reachable >= bound && reachable > 0.0;
    let confidence = found.evidence.and_then(|evidence| calibration.confidence(evidence));
    let confidence = confidence.unwrap_or_default();
    if is_calibrated && confidence < bound {
        return open(format!(
            "its confidence of {confidence:.2} is below {bound} (cascade.stop_confidence)"
        ));
    }
    let close = close_rival(settings, calibration, found, first);
    match (close, is_calibrated) {
        (Some((rival, share)), _) => open(format!(
            "{} agrees with the frame in {:.0} % as many regions, more than {:.0} % (cascade.close)",
            found.candidates[rival].image_id,
            100.0 * share,
            100.0 * settings.close
        )),
        (None, true) => Question::Settled {
            why: format!("its confidence of {confidence:.2} reaches {bound}, and no other is close"),
        },
        (None, false) => Question::Settled {
            why: "the map is not calibrated, or too small for this confidence, and no other candidate is close"
                .into(),
        },
    }
}

/// Returns the candidate of another place that agrees most with the frame, and its share of the regions of the first,
/// if that is too close.
fn close_rival(
    settings: &CascadeSettings,
    calibration: &Calibration,
    found: &LocalFinding<'_>,
    first: usize,
) -> Option<(usize, f32)> {
    let pose = found.candidates[first].pose;
    let place_m = calibration.settings.place_m;
    let rivals = found.order.iter().skip(1).copied();
    rivals
        .filter(|&rival| is_another_place(pose, found.candidates[rival].pose, place_m))
        .map(|rival| (rival, found.agreement.share(rival, first)))
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .filter(|(_, share)| f64::from(*share) > settings.close)
}

/// Images without poses may show the same place, as neighbours of a sequence do.
fn is_another_place(one: Option<Pose>, other: Option<Pose>, place_m: f64) -> bool {
    let distance = one.zip(other).and_then(|(one, other)| one.distance_m(&other));
    distance.is_some_and(|distance| distance > place_m)
}

/// Returns the candidates about which the model is asked, in coarse order: the first ones of `local`, and the first of
/// the search.
pub fn in_question(settings: &CascadeSettings, order: &[usize]) -> Vec<usize> {
    let most = settings.candidates.min(order.len());
    let mut chosen: Vec<usize> = order.iter().copied().take(most).collect();
    if !chosen.contains(&0)
        && let Some(last) = chosen.last_mut()
    {
        *last = 0;
    }
    chosen.sort_unstable();
    chosen
}
