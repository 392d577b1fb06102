//! The order of the candidates after refinement.
//!
//! The coarse similarity is not mixed into the score: on indoor images no weight of it gained
//! anything over the votes alone. It decides where the votes cannot, through the order that it gave
//! the candidates.

use super::PairMatch;

/// By how much a candidate must beat one that the coarse retriever preferred, as a share of that
/// one's score. Scores are sums of a few dozen whole votes; closer than this is chance.
const MARGIN: f32 = 0.1;

/// The least difference of scores that counts, so that a chance match or two are not worth more than
/// none.
const LEAST_DIFFERENCE: f32 = 2e-4;

/// Orders candidates by score: indices into `pairs`, best first, always a permutation of
/// `0..pairs.len()`.
///
/// `pairs` are in coarse order, best first. Each in turn moves up past those before it for as long
/// as it clearly beats them, so that ties and near-ties keep the coarse order.
pub fn rank(pairs: &[PairMatch]) -> Vec<usize> {
    let mut order: Vec<usize> = Vec::with_capacity(pairs.len());
    for (index, pair) in pairs.iter().enumerate() {
        let beaten = order.iter().rev().take_while(|&&other| clearly_beats(pair, &pairs[other]));
        let place = index - beaten.count();
        order.insert(place, index);
    }
    order
}

fn clearly_beats(pair: &PairMatch, other: &PairMatch) -> bool {
    // A score that is not a number is worth nothing, `max` returns the other operand.
    let (score, other) = (pair.score.max(0.0), other.score.max(0.0));
    score > other * (1.0 + MARGIN) + LEAST_DIFFERENCE
}
