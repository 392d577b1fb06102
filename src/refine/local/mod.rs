//! The refiner `local`: matches the regions of a query with those of its candidates, without a language
//! model.
//!
//! Matching has four steps. `cell_matcher` finds the mutual nearest neighbours (`mutual`) among the cells of two pictures,
//! with the nearest neighbours from `integers`, or on processors without the instructions for it from `nearest`.
//! `agreement` keeps the matches whose surroundings moved the same way. `votes` lets each cell of the query share one vote among the candidates, so that
//! regions that every candidate shows count for little. `motion` fits one motion to the remaining matches.
//! `signs` adds what was read in the pictures. [`describe`] describes a pair in words, and [`rank`] ranks the candidates.
//!
//! [`LocalRefiner`] fetches the features of a job and makes a refinement of the matches. The matcher itself
//! does no I/O.

mod agreement;
mod cell_matcher;
mod comparison;
mod describe;
#[cfg(target_arch = "x86_64")]
mod integers;
mod matching;
mod motion;
mod mutual;
mod nearest;
mod rank;
mod refiner;
mod signs;
mod votes;

#[cfg(test)]
mod tests;

pub use describe::{Standing, describe, describe_signs};
pub use motion::Motion;
pub use rank::rank;
pub use refiner::LocalRefiner;
pub(crate) use refiner::{build, fingerprint};

use serde::Serialize;

use cell_matcher::CellMatcher;
use mutual::{CellPair, Mutual};
use votes::Votes;
use whereabouts_core::dense::DenseFeatures;

/// Thresholds of the matcher. The defaults were measured for XFeat. All lengths are fractions of the picture
/// and so hold for any size of feature map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LocalSettings {
    /// Cosine similarity that two cells must exceed to match at all.
    pub min_similarity: f32,
    /// The radius within which a match has neighbours, in fractions of the picture's edges.
    pub neighbourhood: f32,
    /// How much the motions of two neighbours may differ, in fractions of the picture's edges.
    /// Never less than [`grid_slack`](Self::grid_slack) cells.
    pub motion_tolerance: f32,
    /// Cells within which two positions cannot be told apart, because matches sit on a grid.
    pub grid_slack: f32,
    /// The share of the cells around a match that must have moved as it did, 0 to 1.
    pub min_support: f32,
    /// The temperature of the votes, in units of the usual difference between the candidates of the query:
    /// a region that is this much more similar in one candidate than in another gets e (2.7) times the
    /// vote. Small values give the whole vote to the best candidate.
    pub vote_temperature: f32,
    /// Rounds of re-weighting in the fit of the motion.
    pub motion_rounds: usize,
    /// Candidates that are compared at first. The others are compared only if none of these clearly agrees.
    pub first: usize,
    /// The evidence from which a candidate clearly agrees, see
    /// [`Agreement::evidence`](whereabouts_core::Agreement::evidence).
    pub clear_evidence: f32,
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
            first: 20,
            clear_evidence: 0.25,
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
    /// The matches whose surroundings moved the same way, most distinctive first.
    pub matches: Vec<Match>,
    /// The number of `matches` that have no better counterpart in any other candidate of the query.
    pub distinctive: usize,
    /// The number of other candidates in the same comparison.
    pub rivals: usize,
    /// The number of mutual nearest neighbours, before the geometric check.
    pub mutual: usize,
    /// The number of cells of the query that are not zero. Only these are matched.
    pub cells: usize,
    /// The motion that explains most of `matches`.
    pub motion: Motion,
    /// The share of the query's votes that went to this candidate, 0 to 1. Higher means more likely the
    /// same place. Comparable among the candidates of one query only.
    pub score: f32,
}

/// The error of comparing features of different models.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("a query of {query} channels cannot be matched with a candidate of {candidate}")]
pub struct LocalError {
    /// Channels of the query.
    pub query: usize,
    /// Channels of the candidate.
    pub candidate: usize,
}

/// The candidates that a query was compared with so far, in their order.
#[derive(Debug, Default)]
struct Compared {
    mutuals: Vec<Mutual>,
    /// For each, the matches whose surroundings moved the same way.
    agreeing: Vec<Vec<(CellPair, Match)>>,
    /// The query, once it was compared with any.
    query: Option<CellMatcher>,
}

/// Matches the dense features of a query with those of its candidates.
///
/// Deterministic: the same input gives the same output, on any thread.
#[derive(Debug, Clone, Default)]
pub struct LocalMatcher {
    settings: LocalSettings,
    /// Whether cells are compared in floating point also where integers would be faster.
    exact: bool,
}

impl LocalMatcher {
    /// Creates a matcher with these settings.
    pub fn new(settings: LocalSettings) -> Self {
        Self { settings, exact: false }
    }

    /// Creates a matcher that compares cells in floating point, as processors without AVX2 do, and so finds what these
    /// find. Others compare in 16-bit integers, which is faster.
    pub fn in_floats(settings: LocalSettings) -> Self {
        Self { settings, exact: true }
    }

    /// Compares a query with a single candidate, which gets the full vote of every agreeing region.
    ///
    /// # Errors
    /// [`LocalError`] when the features come from different models.
    pub fn compare(
        &self,
        query: &DenseFeatures,
        candidate: &DenseFeatures,
    ) -> Result<PairMatch, LocalError> {
        let mut pairs = self.compare_all(query, &[candidate])?;
        // One candidate gives one pair.
        Ok(pairs.swap_remove(0))
    }

    /// Compares a query with all its candidates, which are in coarse order. The results are in the same
    /// order. Costs one matrix product of the two feature maps for each pair.
    ///
    /// # Errors
    /// [`LocalError`] when any two of the features come from different models.
    pub fn compare_all(
        &self,
        query: &DenseFeatures,
        candidates: &[&DenseFeatures],
    ) -> Result<Vec<PairMatch>, LocalError> {
        let mut compared = Compared::default();
        self.compare_more(query, candidates, &mut compared)?;
        Ok(self.judge_all(query, candidates, &compared))
    }

    /// Compares a query with those of its candidates that `compared` does not have yet.
    fn compare_more(
        &self,
        query: &DenseFeatures,
        candidates: &[&DenseFeatures],
        compared: &mut Compared,
    ) -> Result<(), LocalError> {
        let Compared { mutuals, agreeing, query: prepared } = compared;
        let prepared = prepared.get_or_insert_with(|| CellMatcher::of(query, self.exact));
        for candidate in candidates.get(mutuals.len()..).unwrap_or_default() {
            let found = prepared.find(query, candidate, self.settings.min_similarity)?;
            let (located, tolerance) =
                (found.located(query, candidate), self.tolerance(query, candidate));
            let moved_alike =
                agreement::agreeing(query, &found.pairs, &located, tolerance, &self.settings);
            agreeing.push(moved_alike.collect());
            mutuals.push(found);
        }
        Ok(())
    }

    fn judge_all(
        &self,
        query: &DenseFeatures,
        candidates: &[&DenseFeatures],
        compared: &Compared,
    ) -> Vec<PairMatch> {
        let Compared { mutuals, agreeing, .. } = compared;
        let votes = Votes::count(mutuals, self.settings.vote_temperature);
        let rivals = candidates.len().saturating_sub(1);
        candidates
            .iter()
            .zip(mutuals.iter().zip(agreeing))
            .map(|(candidate, (mutual, agreeing))| {
                let tolerance = self.tolerance(query, candidate);
                self.judge(query, tolerance, mutual, agreeing, &votes, rivals)
            })
            .collect()
    }

    fn judge(
        &self,
        query: &DenseFeatures,
        tolerance: [f32; 2],
        mutual: &Mutual,
        agreeing: &[(CellPair, Match)],
        votes: &Votes,
        rivals: usize,
    ) -> PairMatch {
        let mut agreeing: Vec<(Match, f32, bool)> = agreeing
            .iter()
            .map(|(pair, found)| {
                let vote = votes.share(pair.query, pair.similarity);
                (*found, vote, votes.is_best(pair.query, pair.similarity))
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

    /// Returns how far two positions may differ, as `[x, y]` in fractions of the picture's edges.
    fn tolerance(&self, query: &DenseFeatures, candidate: &DenseFeatures) -> [f32; 2] {
        let coarser = |a: usize, b: usize| self.settings.grid_slack / a.min(b) as f32;
        [
            coarser(query.width(), candidate.width()).max(self.settings.motion_tolerance),
            coarser(query.height(), candidate.height()).max(self.settings.motion_tolerance),
        ]
    }
}
