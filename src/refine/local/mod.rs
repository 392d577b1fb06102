//! The `local` refiner: says how a query and its candidates agree, region by region, without a
//! language model.
//!
//! Four steps, one file each. `mutual` finds the cells of two pictures that choose each other, among
//! what `nearest` found;
//! `agreement` keeps those whose surroundings moved the same way; `votes` lets each remaining
//! cell of the query share one vote among the candidates, so that what every candidate shows counts
//! for little; `motion` fits one motion to what is left. [`describe`] puts the outcome of a pair
//! into words and [`rank`] orders the candidates.
//!
//! Extracting [`DenseFeatures`], choosing the candidates and storing the result are left to others.

mod agreement;
mod describe;
mod motion;
mod mutual;
mod nearest;
mod rank;
mod refiner;
mod votes;

#[cfg(test)]
mod tests;

pub use describe::describe;
pub use motion::Motion;
pub use rank::rank;
pub use refiner::LocalRefiner;
pub(crate) use refiner::{build, fingerprint};

use serde::Serialize;

use mutual::Mutual;
use nearest::Nearest;
use votes::Votes;
use whereabouts_core::dense::DenseFeatures;

/// What the matcher takes for agreement. The defaults are those measured for XFeat; all lengths are
/// fractions of the picture, so that they hold for any size of feature map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LocalSettings {
    /// Cosine similarity that two cells must exceed to match at all.
    pub min_similarity: f32,
    /// How far around a match its neighbours are looked for, in fractions of the picture's edges.
    pub neighbourhood: f32,
    /// How much the motions of two neighbours may differ, in fractions of the picture's edges.
    /// Never less than [`grid_slack`](Self::grid_slack) cells.
    pub motion_tolerance: f32,
    /// Cells within which two positions cannot be told apart, because matches sit on a grid.
    pub grid_slack: f32,
    /// The share of the cells around a match that must have moved as it did, 0 to 1.
    pub min_support: f32,
    /// How much more alike a region must be in one candidate than in another to be e (2.7) times
    /// as likely to be there, in units of the usual difference between the candidates of the query.
    /// Small values let the best candidate take the whole vote.
    pub vote_temperature: f32,
    /// Rounds of re-weighting when the motion is fitted.
    pub motion_rounds: usize,
}

impl Default for LocalSettings {
    fn default() -> Self {
        Self {
            min_similarity: 0.0,
            neighbourhood: 0.16,
            motion_tolerance: 0.1,
            grid_slack: 1.5,
            min_support: 0.06,
            vote_temperature: 2.0,
            motion_rounds: 6,
        }
    }
}

/// One region of the query and its counterpart in the candidate.
///
/// Positions are cell centres in fractions of the picture's width and height, `[x, y]`, with
/// `[0, 0]` at the top left.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Where the region is in the query.
    pub query: [f32; 2],
    /// Where it is in the candidate.
    pub candidate: [f32; 2],
    /// Cosine similarity of the two cells, −1 to 1.
    pub similarity: f32,
}

/// How one query and one candidate agree.
#[derive(Debug, Clone, PartialEq)]
pub struct PairMatch {
    /// The matches whose surroundings moved the same way, most telling first.
    pub matches: Vec<Match>,
    /// How many of `matches` have no better counterpart in any other candidate of the query.
    pub distinctive: usize,
    /// The other candidates that this one was compared beside.
    pub rivals: usize,
    /// Mutual nearest neighbours, before the geometric check.
    pub mutual: usize,
    /// Cells of the query that took part: those that are not zero.
    pub cells: usize,
    /// The one motion that explains most of `matches`.
    pub motion: Motion,
    /// The share of the query's regions whose vote went to this candidate, 0 to 1. Higher means
    /// more likely the same place; comparable among the candidates of one query.
    pub score: f32,
}

/// Why two pictures could not be compared: their features come from different models.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("a query of {query} channels cannot be matched with a candidate of {candidate}")]
pub struct LocalError {
    /// Numbers in a cell of the query.
    pub query: usize,
    /// Numbers in a cell of the candidate.
    pub candidate: usize,
}

/// Compares the dense features of a query with those of its candidates.
///
/// It holds settings only: the same input always gives the same output, on any thread.
#[derive(Debug, Clone, Default)]
pub struct LocalMatcher {
    settings: LocalSettings,
}

impl LocalMatcher {
    /// A matcher with these settings.
    pub fn new(settings: LocalSettings) -> Self {
        Self { settings }
    }

    /// Compares a query with one candidate alone: every agreeing region gives it a full vote.
    ///
    /// # Errors
    /// [`LocalError`] when the features come from different models.
    pub fn compare(
        &self,
        query: &DenseFeatures,
        candidate: &DenseFeatures,
    ) -> Result<PairMatch, LocalError> {
        let least = self.settings.min_similarity;
        let mutual = mutual::find(query, candidate, least, &mut Nearest::default())?;
        let votes = Votes::count(std::slice::from_ref(&mutual), self.settings.vote_temperature);
        Ok(self.judge(query, candidate, &mutual, &votes, 0))
    }

    /// Compares a query with all its candidates, best coarse candidate first; the results are in
    /// the same order. Costs one matrix product of the two feature maps for each pair.
    ///
    /// # Errors
    /// [`LocalError`] when any two of the features come from different models.
    pub fn compare_all(
        &self,
        query: &DenseFeatures,
        candidates: &[&DenseFeatures],
    ) -> Result<Vec<PairMatch>, LocalError> {
        let mut nearest = Nearest::default();
        let least = self.settings.min_similarity;
        let mutuals: Vec<Mutual> = candidates
            .iter()
            .map(|candidate| mutual::find(query, candidate, least, &mut nearest))
            .collect::<Result<_, _>>()?;
        let votes = Votes::count(&mutuals, self.settings.vote_temperature);
        let rivals = candidates.len().saturating_sub(1);
        Ok(candidates
            .iter()
            .zip(&mutuals)
            .map(|(candidate, mutual)| self.judge(query, candidate, mutual, &votes, rivals))
            .collect())
    }

    fn judge(
        &self,
        query: &DenseFeatures,
        candidate: &DenseFeatures,
        mutual: &Mutual,
        votes: &Votes,
        rivals: usize,
    ) -> PairMatch {
        let tolerance = self.tolerance(query, candidate);
        let located = mutual.located(query, candidate);
        let mut agreeing: Vec<(Match, f32, bool)> =
            agreement::agreeing(query, &mutual.pairs, &located, tolerance, &self.settings)
                .map(|(pair, found)| {
                    let vote = votes.share(pair.query, pair.similarity);
                    (found, vote, votes.is_best(pair.query, pair.similarity))
                })
                .collect();
        agreeing
            .sort_by(|a, b| b.1.total_cmp(&a.1).then(b.0.similarity.total_cmp(&a.0.similarity)));

        let weights: Vec<f32> = agreeing.iter().map(|(_, vote, _)| *vote).collect();
        let distinctive = agreeing.iter().filter(|(_, _, best)| *best).count();
        let matches: Vec<Match> = agreeing.into_iter().map(|(found, ..)| found).collect();
        let motion = motion::fit(&matches, &weights, tolerance, query, self.settings.motion_rounds);
        let cells = mutual.cells();
        PairMatch {
            distinctive,
            rivals,
            mutual: mutual.pairs.len(),
            cells,
            motion,
            score: weights.iter().sum::<f32>() / cells.max(1) as f32,
            matches,
        }
    }

    /// How far two positions may differ, `[x, y]` in fractions of the picture's edges.
    fn tolerance(&self, query: &DenseFeatures, candidate: &DenseFeatures) -> [f32; 2] {
        let coarser = |a: usize, b: usize| self.settings.grid_slack / a.min(b) as f32;
        [
            coarser(query.width(), candidate.width()).max(self.settings.motion_tolerance),
            coarser(query.height(), candidate.height()).max(self.settings.motion_tolerance),
        ]
    }
}
