//! The ranking of the candidates by their votes.
//!
//! The coarse similarity is not part of the score: on indoor images no weight of it improved on the votes
//! alone. It decides near-ties, because these keep the coarse order.

use super::PairMatch;

/// The margin by which a candidate must beat one of a better coarse rank, as a share of that one's score.
/// Scores are sums of a few dozen votes, so that smaller differences are chance.
const MARGIN: f32 = 0.1;

/// The least difference of scores that counts. One or two chance matches are worth less than this.
const LEAST_DIFFERENCE: f32 = 2e-4;

/// Ranks candidates by score. Returns indices into `pairs`, best first, always a permutation of
/// `0..pairs.len()`.
///
/// `pairs` are in coarse order. Each in turn moves up past those before it as long as it clearly beats
/// them, so that ties and near-ties keep the coarse order.
pub fn rank(pairs: &[PairMatch]) -> Vec<usize> {
    let mut order: Vec<usize> = Vec::with_capacity(pairs.len());
    for (index, pair) in pairs.iter().enumerate() {
        let beaten = order.iter().rev().take_while(|&&other| clearly_beats(pair, &pairs[other]));
        let position = index - beaten.count();
        order.insert(position, index);
    }
    order
}

fn clearly_beats(pair: &PairMatch, other: &PairMatch) -> bool {
    // `max` returns the other operand of a NaN, so that a NaN score counts as 0.
    let (score, other) = (pair.score.max(0.0), other.score.max(0.0));
    score > other * (1.0 + MARGIN) + LEAST_DIFFERENCE
}
