//! What comes of comparing a query with its candidates: which agree, and whether one does so clearly.

use std::time::Duration;

use super::PairMatch;
use whereabouts_core::{Agreement, Evidence, SamePlace};

/// The outcome of matching a query with those of its candidates that are still in the map.
pub(super) struct Comparison {
    /// The number of candidates.
    pub candidates: usize,
    /// The number of candidates that were looked up; the others were not needed.
    pub considered: usize,
    /// The indices of those that are still in the map.
    pub present: Vec<usize>,
    /// How each of them agrees with the query.
    pub pairs: Vec<PairMatch>,
    /// Indices of the pairs, best first.
    pub order: Vec<usize>,
    /// Duration of the matching, without fetching and extraction.
    pub took: Duration,
    /// Which of all candidates show the same place.
    pub same_place: SamePlace,
    /// The same of those that are present.
    pub present_same_place: SamePlace,
}

impl Comparison {
    /// Returns how many regions of the query agree with each candidate that is present.
    pub fn agreement(&self) -> Agreement {
        agreement(&self.pairs, &self.order, self.present_same_place.clone())
    }

    /// Returns the same for all candidates; 0 for one that was removed.
    pub fn agreement_of_all(&self) -> Agreement {
        let of_present = self.agreement();
        let mut matches = vec![0; self.candidates];
        for (&index, count) in self.present.iter().zip(of_present.matches) {
            matches[index] = count;
        }
        let first = of_present.first.map(|first| self.present[first]);
        Agreement { matches, first, same_place: self.same_place.clone(), ..of_present }
    }
}

/// How many regions of a query agree with each candidate, of which `order` has the best first.
pub(super) fn agreement(pairs: &[PairMatch], order: &[usize], same_place: SamePlace) -> Agreement {
    Agreement {
        regions: pairs.first().map_or(0, |pair| pair.cells),
        matches: pairs.iter().map(|pair| pair.matches.len()).collect(),
        first: order.first().copied(),
        same_place,
    }
}

/// Whether the first candidate agrees so clearly that others need not be compared: whether its evidence, which also
/// decides about the confidence, reaches `clear_evidence`. Never if all candidates show its place: nothing is known of
/// others then.
pub(super) fn is_clear(agreement: &Agreement, clear_evidence: f32) -> bool {
    let Some(first) = agreement.first else { return false };
    let mut others = 0..agreement.matches.len();
    let has_rival = others.any(|other| !agreement.same_place.contains(first, other));
    match agreement.evidence(first) {
        Some(Evidence::Agreement(evidence)) => has_rival && evidence >= clear_evidence,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::CalibrationSettings;

    fn found(matches: &[usize], places: &[usize]) -> Agreement {
        // Images that were added one after another show one place.
        let settings = CalibrationSettings { place_images: 5, ..CalibrationSettings::default() };
        let places: Vec<_> = places.iter().map(|place| (Some(100 * place), None)).collect();
        let same_place = SamePlace::of(&places, 1000, &settings);
        Agreement { regions: 1000, matches: matches.to_vec(), first: Some(0), same_place }
    }

    #[test]
    fn a_candidate_is_clear_by_the_evidence_that_its_confidence_has() {
        let near = found(&[400, 380, 20, 10], &[1, 1, 2, 3]);
        let Some(Evidence::Agreement(evidence)) = near.evidence(0) else { panic!("no evidence") };
        assert!(is_clear(&near, evidence) && !is_clear(&near, evidence + 0.01));
        // Another place that agrees as much.
        assert!(!is_clear(&found(&[400, 380, 20, 10], &[1, 2, 3, 4]), evidence));
    }

    #[test]
    fn nothing_is_clear_without_another_place_to_compare_with() {
        assert!(!is_clear(&found(&[400, 380], &[1, 1]), 0.5));
        assert!(!is_clear(&found(&[400], &[1]), 0.5));
        let nothing = Agreement { first: None, ..found(&[], &[]) };
        assert!(!is_clear(&nothing, 0.5));
    }
}
