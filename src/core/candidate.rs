//! Candidates of coarse retrieval, and their order after refinement.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{ImageId, Pose};

/// A reference image returned by coarse retrieval.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Candidate {
    /// Rank in the coarse order; 1 is the most similar.
    pub rank: usize,
    /// Id of the reference image.
    pub image_id: ImageId,
    /// Cosine similarity of its descriptor and the query's, −1 to 1.
    pub similarity: f32,
    /// Pose of the reference image, if known.
    pub pose: Option<Pose>,
    /// Position of the reference image in the order of addition, with gaps where images were removed. Known after a
    /// search; not part of the API, and not stored with a job.
    #[serde(skip)]
    #[schema(ignore)]
    pub order: Option<usize>,
}

/// A candidate after refinement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RankedCandidate {
    /// Rank in the refined order; 1 is the most likely to show the same place.
    pub rank: usize,
    /// Id of the reference image.
    pub image_id: ImageId,
    /// Rank in the coarse order.
    pub coarse_rank: usize,
    /// Pose of the reference image, if known.
    pub pose: Option<Pose>,
}

/// The candidates of a job in their refined order. Always a permutation of the candidates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Ranking(Vec<RankedCandidate>);

/// The order is not a permutation of the candidates.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("an order of {got} indices is not a permutation of {candidates} candidates")]
pub struct RankingError {
    /// Number of candidates.
    pub candidates: usize,
    /// Number of indices in the order.
    pub got: usize,
}

impl Ranking {
    /// Arranges `candidates` by `order`, a list of their indices, best first.
    pub fn new(candidates: &[Candidate], order: &[usize]) -> Result<Self, RankingError> {
        let invalid = RankingError { candidates: candidates.len(), got: order.len() };
        if order.len() != candidates.len() {
            return Err(invalid);
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
                _ => return Err(invalid),
            }
        }
        Ok(Self(ranked))
    }

    /// The candidates, best first.
    pub fn as_slice(&self) -> &[RankedCandidate] {
        &self.0
    }

    /// The best candidate; `None` if there are no candidates.
    pub fn first(&self) -> Option<&RankedCandidate> {
        self.0.first()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn candidates(count: usize) -> Vec<Candidate> {
        (0..count)
            .map(|i| Candidate {
                rank: i + 1,
                image_id: format!("image-{i}").parse().unwrap(),
                similarity: 1.0 - i as f32 / 10.0,
                pose: None,
                order: None,
            })
            .collect()
    }

    #[test]
    fn a_ranking_keeps_the_coarse_ranks() {
        let ranking = Ranking::new(&candidates(3), &[2, 0, 1]).unwrap();
        let ranks: Vec<_> = ranking.as_slice().iter().map(|c| (c.rank, c.coarse_rank)).collect();
        assert_eq!(ranks, [(1, 3), (2, 1), (3, 2)]);
    }

    #[test]
    fn an_order_that_is_not_a_permutation_is_rejected() {
        for order in [&[0, 0, 1][..], &[0, 1], &[0, 1, 3], &[0, 1, 2, 2]] {
            assert!(Ranking::new(&candidates(3), order).is_err(), "{order:?}");
        }
    }

    proptest! {
        #[test]
        fn a_ranking_is_a_permutation_of_the_candidates(
            order in (0..12_usize).prop_flat_map(|count| {
                Just((0..count).collect::<Vec<_>>()).prop_shuffle()
            }),
        ) {
            let candidates = candidates(order.len());
            let ranking = Ranking::new(&candidates, &order).unwrap();
            prop_assert_eq!(ranking.first(), ranking.as_slice().first());
            let mut coarse = Vec::new();
            for (position, ranked) in ranking.as_slice().iter().enumerate() {
                let candidate = &candidates[order[position]];
                prop_assert_eq!(ranked.rank, position + 1);
                prop_assert_eq!(&ranked.image_id, &candidate.image_id);
                prop_assert_eq!(ranked.coarse_rank, candidate.rank);
                coarse.push(ranked.coarse_rank);
            }
            coarse.sort_unstable();
            prop_assert!(coarse.into_iter().eq(1..=candidates.len()));
        }

        #[test]
        fn an_order_is_accepted_exactly_if_it_is_a_permutation(
            count in 0..6_usize,
            order in proptest::collection::vec(0..7_usize, 0..7),
        ) {
            let mut sorted = order.clone();
            sorted.sort_unstable();
            let is_permutation = sorted.into_iter().eq(0..count);
            prop_assert_eq!(Ranking::new(&candidates(count), &order).is_ok(), is_permutation);
        }
    }
}
