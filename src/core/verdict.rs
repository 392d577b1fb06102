//! What a model's verdict is worth as evidence.
//!
//! A model says which candidate shows the place of a frame, and how certain it is. Neither can be taken at its word:
//! models are over-confident, and some are wrong. What counts is how far the regions of the two pictures bear the
//! verdict out, which costs no call, and how often the model says the same of wrong images:
//!
//! > e = ln((a + c) / (m + c)) − 2 · max(0, ln((b + c) / (a + c))) − d
//!
//! where a regions of the model's first candidate match the frame, m is the mean of the two largest such counts among the
//! candidates of other places, b the largest of all, c is [`SUPPORT_SHARE`](super::confidence::SUPPORT_SHARE) of the regions of the frame, and
//! d is the model's doubt. The second term is the contradiction: another candidate matches the frame better.
//!
//! Where the regions put the same candidate first, or nearly, as they do with neighbours that show the same place, the
//! model concurs, and the evidence of the regions counts too.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::confidence::{chance, support};
use super::{CalibrationSettings, Evidence, Pose};

/// The weight of a contradiction: as strong a match of another candidate turns evidence for the first one into as much
/// against it.
const CONTRADICTION: f32 = 2.0;

/// The number of candidates of other places with which one is compared.
const RIVALS: usize = 2;

/// The share of the regions of the first candidate from which another is nearly as good.
const NEARLY: f32 = 0.7;

/// How sure a model is that its first candidate shows the place of the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Certainty {
    /// It is the place.
    Certain,
    /// It is more likely than not.
    Likely,
    /// It may be.
    Unsure,
    /// None of the candidates shows the place.
    None,
}

impl Certainty {
    /// Returns its name in the API.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Certain => "certain",
            Self::Likely => "likely",
            Self::Unsure => "unsure",
            Self::None => "none",
        }
    }

    /// Returns how much the evidence is lowered, in units of the logarithm. A model that says nothing of its certainty
    /// counts as one that takes its candidate for likely.
    fn doubt(certainty: Option<Self>) -> f32 {
        match certainty {
            Some(Self::Certain) => 0.0,
            Some(Self::Likely) | None => 0.5,
            Some(Self::Unsure) => 1.5,
            Some(Self::None) => f32::INFINITY,
        }
    }
}

/// How many regions of a frame match each of its candidates.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Agreement {
    /// The number of regions of the frame.
    pub regions: usize,
    /// The number of them that match, for each candidate in coarse order; 0 for one that was removed.
    pub matches: Vec<usize>,
    /// The candidate that `local` puts first, by regions and signs, if there is one.
    pub first: Option<usize>,
    /// Which candidates show the same place.
    pub same_place: SamePlace,
}

/// Which of some images show the same place, as far as their order of addition and their poses say so.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SamePlace(Vec<Vec<bool>>);

impl SamePlace {
    /// Compares images of a map with `images` images, each given by its index in order of addition and its pose.
    pub fn of(
        places: &[(Option<usize>, Option<Pose>)],
        images: usize,
        settings: &CalibrationSettings,
    ) -> Self {
        let same =
            |one: &(Option<usize>, Option<Pose>), other: &(Option<usize>, Option<Pose>)| !match one
                .0
                .zip(other.0)
            {
                Some((a, b)) => settings.are_apart(images, (a, one.1), (b, other.1)),
                None => settings.are_distant(one.1, other.1),
            };
        let row = |one| places.iter().map(|other| same(one, other)).collect();
        Self(places.iter().map(row).collect())
    }

    /// Whether two of them, given by index, show the same place. An image of which nothing is known shows one of its own.
    pub fn contains(&self, one: usize, other: usize) -> bool {
        one == other || self.0.get(one).and_then(|row| row.get(other)).copied().unwrap_or_default()
    }
}

impl Agreement {
    /// Returns the evidence for the candidate at index `of`: ln((a + c) / (m + c)), where a regions of it match the frame,
    /// m is the mean of the two largest such counts among the candidates of other places, and c is
    /// [`SUPPORT_SHARE`](super::confidence::SUPPORT_SHARE) of the regions of the frame. The best of another place is what a
    /// wrong answer has to be told from, and images of the same place say nothing against it. Where all candidates show one
    /// place, m is 0. `None` if there is no other candidate.
    pub fn evidence(&self, of: usize) -> Option<Evidence> {
        let one = *self.matches.get(of)?;
        if self.matches.len() < 2 {
            return None;
        }
        let others = self.matches.iter().enumerate();
        let mut others: Vec<usize> = others
            .filter(|(other, _)| !self.same_place.contains(of, *other))
            .map(|(_, matches)| *matches)
            .collect();
        others.sort_unstable_by(|a, b| b.cmp(a));
        others.truncate(RIVALS);
        let rival = others.iter().sum::<usize>() as f32 / others.len().max(1) as f32;
        let support = support(self.regions);
        Some(Evidence::Agreement(((one as f32 + support) / (rival + support)).ln()))
    }

    /// Returns the evidence for the candidate at index `of`, which a model put first. `None` if there is no other
    /// candidate.
    pub fn verdict(&self, of: usize, certainty: Option<Certainty>) -> Option<Evidence> {
        if certainty == Some(Certainty::None) {
            return Some(Evidence::NONE_OF_THESE);
        }
        let Evidence::Agreement(agreement) = self.evidence(of)? else {
            return None;
        };
        let support = support(self.regions);
        let one = *self.matches.get(of)? as f32;
        let best = self.matches.iter().copied().max()? as f32;
        let contradiction = ((best + support) / (one + support)).ln();
        let verdict = agreement - CONTRADICTION * contradiction - Certainty::doubt(certainty);
        let concurs = self.first.is_some_and(|first| self.share(of, first) >= NEARLY);
        Some(match concurs && certainty != Some(Certainty::Unsure) {
            true => Evidence::Concurring { verdict, agreement },
            false => Evidence::Verdict(verdict),
        })
    }

    /// Returns how many regions match the candidate at index `of`, as a share of those that match `other`, with as many
    /// added as match by chance. An index out of range counts as no match.
    pub fn share(&self, of: usize, other: usize) -> f32 {
        let matches = |index: usize| self.matches.get(index).copied().unwrap_or_default() as f32;
        let chance = chance(self.regions);
        (matches(of) + chance) / (matches(other) + chance)
    }

    /// Returns the strongest evidence that any verdict of this certainty on these candidates can have.
    pub fn strongest_verdict(&self, certainty: Option<Certainty>) -> Option<Evidence> {
        let most = self.matches.iter().max()?;
        let of = self.matches.iter().position(|matches| matches == most)?;
        Self { first: None, ..self.clone() }.verdict(of, certainty)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn agreement(matches: &[usize]) -> Agreement {
        let same_place = SamePlace::default();
        Agreement { regions: 500, matches: matches.to_vec(), first: None, same_place }
    }

    fn value(evidence: Option<Evidence>) -> f32 {
        match evidence {
            Some(Evidence::Verdict(value)) => value,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_evidence_is_the_log_ratio_to_the_two_best_of_other_places() {
        let ratio = |matches: &[usize], regions, same_place| {
            let agreement =
                Agreement { regions, matches: matches.to_vec(), first: None, same_place };
            match agreement.evidence(1) {
                Some(Evidence::Agreement(ratio)) => ratio,
                other => panic!("{other:?}"),
            }
        };
        let apart = SamePlace::default;
        let is =
            |found: f32, expected: f32| assert!((found - expected.ln()).abs() < 1e-6, "{found}");
        is(ratio(&[3, 39, 1, 1, 5], 50, apart()), 43.0 / 8.0);
        is(ratio(&[3, 39], 50, apart()), 43.0 / 7.0);
        // A few regions against none are less than many against some.
        assert!(ratio(&[0, 11, 0], 1200, apart()) < 0.5);
        assert!(ratio(&[50, 600, 50], 1200, apart()) > 1.5);
        // What shows the same place says nothing against it: neighbours in order of addition.
        let settings = CalibrationSettings { place_images: 1, ..CalibrationSettings::default() };
        let places = [7, 8, 30, 9, 31].map(|order| (Some(order), None));
        let neighbours = SamePlace::of(&places, 100, &settings);
        is(ratio(&[38, 39, 1, 38, 5], 50, neighbours), 43.0 / 7.0);
        let places = [7, 8, 7, 9, 9].map(|order| (Some(order), None));
        is(ratio(&[38, 39, 1, 38, 5], 50, SamePlace::of(&places, 100, &settings)), 43.0 / 4.0);
    }

    #[test]
    fn images_show_the_same_place_by_their_poses_or_their_order_of_addition() {
        let at = |x: f64| {
            let pose = serde_json::json!({ "x": x, "y": 0.0 });
            Some(serde_json::from_value::<Pose>(pose).unwrap())
        };
        let settings = CalibrationSettings {
            place_images: 2,
            place_m: 10.0,
            ..CalibrationSettings::default()
        };
        let places = [
            (Some(0), at(0.0)),
            (Some(40), at(9.0)),
            (Some(1), at(90.0)),
            (None, None),
            (None, at(5.0)),
        ];
        let same = SamePlace::of(&places, 100, &settings);
        let of_first: Vec<bool> = (0..5).map(|other| same.contains(0, other)).collect();
        assert_eq!(of_first, [true, true, true, false, true]);
        // In a small map, order says less.
        assert!(!SamePlace::of(&places, 9, &settings).contains(0, 2));
        assert!(!SamePlace::default().contains(0, 1) && SamePlace::default().contains(1, 1));
    }

    #[test]
    fn a_verdict_that_the_regions_contradict_is_evidence_against_itself() {
        let agreement = agreement(&[300, 40, 30, 20]);
        let certain = |of| value(agreement.verdict(of, Some(Certainty::Certain)));
        assert!((certain(0) - (340.0_f32 / 75.0).ln()).abs() < 1e-6, "{}", certain(0));
        assert!(certain(1) < -3.0 && certain(1) > certain(3));
        let certainty = Some(Certainty::Certain);
        assert_eq!(agreement.strongest_verdict(certainty), agreement.verdict(0, certainty));
    }

    #[test]
    fn a_model_that_concurs_with_the_regions_is_believed_as_they_are() {
        let regions = Agreement { first: Some(0), ..agreement(&[300, 310, 30, 20]) };
        let Some(Evidence::Concurring { verdict, agreement }) = regions.verdict(0, None) else {
            panic!("{:?}", regions.verdict(0, None))
        };
        assert_eq!(regions.evidence(0), Some(Evidence::Agreement(agreement)));
        assert!(verdict < agreement);
        // Neighbours show the same place.
        let nearly = regions.verdict(1, Some(Certainty::Certain));
        assert!(matches!(nearly, Some(Evidence::Concurring { .. })), "{nearly:?}");
        for (of, certainty) in [(2, Certainty::Certain), (0, Certainty::Unsure)] {
            let evidence = regions.verdict(of, Some(certainty));
            assert!(matches!(evidence, Some(Evidence::Verdict(_))), "{evidence:?}");
        }
    }

    #[test]
    fn doubt_lowers_the_evidence_and_none_of_these_ends_it() {
        let agreement = agreement(&[300, 40, 30, 20]);
        let of = |certainty| value(agreement.verdict(0, certainty));
        assert!(of(Some(Certainty::Certain)) > of(Some(Certainty::Likely)));
        assert_eq!(of(None), of(Some(Certainty::Likely)));
        assert!(of(None) > of(Some(Certainty::Unsure)));
        assert_eq!(agreement.verdict(0, Some(Certainty::None)), Some(Evidence::NONE_OF_THESE));
    }

    #[test]
    fn a_single_candidate_has_nothing_to_be_compared_with() {
        assert_eq!(agreement(&[300]).verdict(0, None), None);
        assert_eq!(agreement(&[]).strongest_verdict(None), None);
        assert_eq!(agreement(&[300, 1]).verdict(2, None), None);
    }
}
