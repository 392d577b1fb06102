//! Candidates of coarse retrieval, and the order that refinement gives them.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{ImageId, Pose};

/// A reference image that coarse retrieval proposes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Candidate {
    /// Its place in the coarse order; 1 is the most similar.
    pub rank: usize,
    /// The image.
    pub image_id: ImageId,
    /// Cosine similarity of its descriptor to the query's, −1 to 1.
    pub similarity: f32,
    /// Where it was taken from, if known.
    pub pose: Option<Pose>,
}

/// A candidate after refinement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RankedCandidate {
    /// Its place in the refined order; 1 is the most likely same place.
    pub rank: usize,
    /// The image.
    pub image_id: ImageId,
    /// Its place in the coarse order.
    pub coarse_rank: usize,
    /// Where it was taken from, if known.
    pub pose: Option<Pose>,
}

/// The refined order of a job's candidates: always a permutation of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Ranking(Vec<RankedCandidate>);

/// An order that is not a permutation of the candidates.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("an order of {got} places is not a permutation of {candidates} candidates")]
pub struct RankingError {
    /// How many candidates there are.
    pub candidates: usize,
    /// How many places the order has.
    pub got: usize,
}

impl Ranking {
    /// Orders `candidates` by `order`, which lists their indices, best first.
    pub fn new(candidates: &[Candidate], order: &[usize]) -> Result<Self, RankingError> {
        let refused = RankingError { candidates: candidates.len(), got: order.len() };
        if order.len() != candidates.len() {
            return Err(refused);
        }
        let mut seen = vec![false; candidates.len()];
        let mut ranked = Vec::with_capacity(order.len());
        for (position, &index) in order.iter().enumerate() {
            match (candidates.get(index), seen.get_mut(index)) {
                (Some(candidate), Some(seen)) if !*seen => {
                    *seen = true;
                    ranked.push(RankedCandidate {
                        rank: position + 1,
                        image_id: candidate.image_id.clone(),
                        coarse_rank: candidate.rank,
                        pose: candidate.pose,
                    });
                }
                _ => return Err(refused),
            }
        }
        Ok(Self(ranked))
    }

    /// The candidates, best first.
    pub fn as_slice(&self) -> &[RankedCandidate] {
        &self.0
    }

    /// The best candidate, if there is any.
    pub fn first(&self) -> Option<&RankedCandidate> {
        self.0.first()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidates(count: usize) -> Vec<Candidate> {
        (0..count)
            .map(|i| Candidate {
                rank: i + 1,
                image_id: format!("image-{i}").parse().unwrap(),
                similarity: 1.0 - i as f32 / 10.0,
                pose: None,
            })
            .collect()
    }

    #[test]
    fn a_ranking_remembers_the_coarse_rank() {
        let ranking = Ranking::new(&candidates(3), &[2, 0, 1]).unwrap();
        let ranks: Vec<_> = ranking.as_slice().iter().map(|c| (c.rank, c.coarse_rank)).collect();
        assert_eq!(ranks, [(1, 3), (2, 1), (3, 2)]);
    }

    #[test]
    fn what_is_no_permutation_is_no_ranking() {
        for order in [&[0, 0, 1][..], &[0, 1], &[0, 1, 3], &[0, 1, 2, 2]] {
            assert!(Ranking::new(&candidates(3), order).is_err(), "{order:?}");
        }
    }
}
