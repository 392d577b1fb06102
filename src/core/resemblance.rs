//! What the similarities of a frame's candidates are worth as evidence.
//!
//! > e = ln((a + c) / (m + c))
//!
//! a is the support of the first candidate, m the median support of the candidates of other places, and c is
//! [`PRIOR`]. The support of a candidate is its similarity, and that of the images which were added shortly before or
//! after it, as far as these are candidates too: by how much they are more similar than the last candidate, weighted by
//! how much such images have in common in this map. Where a map is a video, neighbours that are found together are
//! evidence; where each of its images shows a place of its own, nothing is added.
//!
//! The ratio is that of what the frame itself resembles, because a frame of another hour is less similar to right and
//! wrong images alike.

use super::verdict::SamePlace;
use super::{CalibrationSettings, Candidate, ImageId};

/// Number of first candidates that are compared.
pub const COMPARED: usize = 10;

/// Added to both sides of a comparison, so that the ratio of two low similarities is no strong evidence.
const PRIOR: f32 = 0.1;

/// Returns the evidence for the image `of` by the similarities of the first [`COMPARED`] candidates, in a map with
/// `images` images. `weights` are the [`neighbour_weights`] of the map. `None` if the image is not among them or is the
/// only one.
pub(super) fn evidence(
    candidates: &[Candidate],
    of: &ImageId,
    (images, settings): (usize, &CalibrationSettings),
    weights: &[f32],
) -> Option<f32> {
    let compared = &candidates[..candidates.len().min(COMPARED)];
    let of = compared.iter().position(|candidate| candidate.image_id == *of)?;
    let last = compared.iter().map(|candidate| candidate.similarity).reduce(f32::min)?;
    if compared.len() < 2 {
        return None;
    }
    let weight = |one: &Candidate, other: &Candidate| {
        let (one, other) = one.order.zip(other.order)?;
        weights.get(one.abs_diff(other).checked_sub(1)?).copied()
    };
    let support = |one: &Candidate| {
        let near = compared.iter().filter_map(|other| {
            weight(one, other).map(|weight| weight * (other.similarity - last))
        });
        one.similarity + near.sum::<f32>()
    };
    let places: Vec<_> = compared.iter().map(|one| (one.order, one.pose)).collect();
    let same_place = SamePlace::of(&places, images, settings);
    let apart = compared.iter().enumerate().filter(|(other, _)| !same_place.contains(of, *other));
    // All candidates may show one place.
    let rival = median(apart.map(|(_, other)| support(other)).collect()).unwrap_or(last);
    let positive = |support: f32| support.max(0.0) + PRIOR;
    Some((positive(support(&compared[of])) / positive(rival)).ln())
}

/// Returns what an image has in common with the one that was added 1, 2, … images later, from 0 to 1: how much more
/// similar they are than images far apart, relative to an image and itself. `near` are the similarities of some pairs at
/// each of these distances, `far` those of some pairs far apart.
pub fn neighbour_weights(near: &[Vec<f32>], far: &[f32]) -> Vec<f32> {
    let Some(usual) = mean(far) else { return Vec::new() };
    let weight = |near: f32| ((near - usual) / (1.0 - usual).max(f32::EPSILON)).clamp(0.0, 1.0);
    near.iter().map(|near| mean(near).map_or(0.0, weight)).collect()
}

fn mean(values: &[f32]) -> Option<f32> {
    (!values.is_empty()).then(|| values.iter().sum::<f32>() / values.len() as f32)
}

/// The median; `None` if `values` is empty.
fn median(mut values: Vec<f32>) -> Option<f32> {
    values.sort_by(f32::total_cmp);
    let (low, high) =
        (values.get(values.len().checked_sub(1)? / 2)?, values.get(values.len() / 2)?);
    Some((low + high) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Candidates of these places in the order of addition, with these similarities.
    fn candidates(found: &[(usize, f32)]) -> Vec<Candidate> {
        let one = |(index, &(order, similarity)): (usize, &(usize, f32))| Candidate {
            rank: index + 1,
            image_id: order.to_string().parse().unwrap(),
            similarity,
            pose: None,
            order: Some(order),
        };
        found.iter().enumerate().map(one).collect()
    }

    fn of(found: &[Candidate], weights: &[f32]) -> Option<f32> {
        let settings = CalibrationSettings {
            place_images: 2,
            place_m: 25.0,
            ..CalibrationSettings::default()
        };
        evidence(found, &found.first()?.image_id, (100, &settings), weights)
    }

    fn is(found: Option<f32>, a: f32, m: f32) {
        let expected = ((a + PRIOR) / (m + PRIOR)).ln();
        assert!((found.unwrap() - expected).abs() < 1e-5, "{found:?} is not {expected}");
    }

    #[test]
    fn the_evidence_is_the_log_ratio_to_the_median_of_other_places() {
        is(of(&candidates(&[(7, 0.9), (20, 0.5), (40, 0.4), (60, 0.1)]), &[]), 0.9, 0.4);
        // Neighbours show the same place.
        is(of(&candidates(&[(7, 0.9), (8, 0.8), (40, 0.4), (9, 0.3)]), &[]), 0.9, 0.4);
        // Only the first ten are compared.
        let many: Vec<_> = (0..40).map(|n| (10 * n, if n < 10 { 0.5 } else { 0.0 })).collect();
        is(of(&candidates(&[&[(900, 0.75)], &many[..]].concat()), &[]), 0.75, 0.5);
        // Dissimilar images are no evidence against anything.
        is(of(&candidates(&[(7, -0.2), (20, -0.3)]), &[]), 0.0, 0.0);
    }

    #[test]
    fn neighbours_that_are_found_too_support_a_place_as_much_as_neighbours_share_in_this_map() {
        let found = candidates(&[(7, 0.6), (8, 0.5), (40, 0.4), (41, 0.3), (60, 0.2)]);
        let others = [0.4 + 0.5 * 0.1, 0.3 + 0.5 * 0.2, 0.2];
        is(of(&found, &[0.5]), 0.6 + 0.5 * 0.3, others[1]);
        is(of(&found, &[]), 0.6, 0.3);
        // Where the order of addition is not known, as in a stored job, there is no support.
        let unordered: Vec<Candidate> =
            found.into_iter().map(|found| Candidate { order: None, ..found }).collect();
        is(of(&unordered, &[0.5]), 0.6, 0.35);
    }

    #[test]
    fn a_candidate_has_no_evidence_alone_and_all_of_one_place_are_compared_with_the_last() {
        assert_eq!(of(&candidates(&[(7, 0.9)]), &[]), None);
        assert_eq!(of(&[], &[]), None);
        is(of(&candidates(&[(7, 0.9), (8, 0.8), (9, 0.3)]), &[]), 0.9, 0.3);
        let settings = CalibrationSettings::default();
        let found = candidates(&[(7, 0.9), (30, 0.8)]);
        assert_eq!(evidence(&found, &"99".parse().unwrap(), (100, &settings), &[]), None);
    }

    #[test]
    fn what_neighbours_share_is_relative_to_images_far_apart() {
        let near = [vec![0.7, 0.5], vec![0.3], vec![0.1], Vec::new()];
        let weights = neighbour_weights(&near, &[0.1, 0.3]);
        let expected = [0.5, 0.125, 0.0, 0.0];
        assert!(weights.iter().zip(expected).all(|(w, e)| (w - e).abs() < 1e-6), "{weights:?}");
        assert!(neighbour_weights(&near, &[]).is_empty());
        // Identical images everywhere share nothing that tells places apart.
        assert_eq!(neighbour_weights(&[vec![1.0]], &[1.0]), [0.0]);
    }
}
