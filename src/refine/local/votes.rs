//! Votes: how strongly a region speaks for one candidate rather than the others.
//!
//! Every cell of the query shares one vote among the candidates in proportion to `exp(s / t)`, where `s` is
//! its highest similarity to any cell of the candidate and `t` a temperature. A wall, a lens rim or a
//! repeated door that all candidates show gives each the same small share; a sign that only one of them
//! shows gives that one nearly the whole vote. This is naive-Bayes nearest neighbour with a local
//! background (McCann & Lowe, "Local NBNN", CVPR 2012), with the candidates as the classes.

use super::mutual::Mutual;

/// Keeps votes defined if all candidates are the same picture or there is only one.
const LEAST_TEMPERATURE: f32 = 1e-6;

/// The normalisation of the votes of each query cell over all candidates.
#[derive(Debug)]
pub(super) struct Votes {
    /// The highest similarity among all candidates.
    peak: Vec<f32>,
    /// The sum of `exp((s - peak) / t)`; at least 1 where `peak` is finite.
    total: Vec<f32>,
    temperature: f32,
}

impl Votes {
    /// Sums over the candidates, whose `mutuals` are all of the same query. `temperature` is in units of
    /// the [`spread`] of their similarities, because backbones differ tenfold in how far apart they place
    /// dissimilar cells.
    pub fn count(mutuals: &[Mutual], temperature: f32) -> Self {
        let cells = mutuals.first().map_or(0, |mutual| mutual.best.len());
        let temperature = (temperature * spread(mutuals, cells)).max(LEAST_TEMPERATURE);
        let peak: Vec<f32> =
            (0..cells).map(|cell| over(mutuals, cell).fold(f32::NEG_INFINITY, f32::max)).collect();
        let total = (0..cells)
            .map(|cell| over(mutuals, cell).map(|s| ((s - peak[cell]) / temperature).exp()).sum())
            .collect();
        Self { peak, total, temperature }
    }

    /// Returns the part of the cell's vote that a candidate with this `similarity` gets, 0 to 1.
    pub fn share(&self, cell: usize, similarity: f32) -> f32 {
        let share = ((similarity - self.peak[cell]) / self.temperature).exp() / self.total[cell];
        if share.is_finite() { share } else { 0.0 }
    }

    /// Returns whether no candidate has a better counterpart for the cell.
    pub fn is_best(&self, cell: usize, similarity: f32) -> bool {
        similarity >= self.peak[cell]
    }
}

/// Returns a cell's highest similarity to each candidate in turn.
fn over(mutuals: &[Mutual], cell: usize) -> impl Iterator<Item = f32> {
    mutuals.iter().map(move |mutual| mutual.best[cell])
}

/// Returns the usual difference between candidates: the standard deviation of a cell's highest similarity
/// over the candidates, as a quadratic mean over the cells.
fn spread(mutuals: &[Mutual], cells: usize) -> f32 {
    let candidates = mutuals.len() as f32;
    let variances = (0..cells).map(|cell| {
        let mean = over(mutuals, cell).sum::<f32>() / candidates;
        over(mutuals, cell).map(|s| (s - mean) * (s - mean)).sum::<f32>() / candidates
    });
    let (sum, count) = variances
        .filter(|variance| variance.is_finite())
        .fold((0.0f32, 0usize), |(sum, count), variance| (sum + variance, count + 1));
    (sum / count.max(1) as f32).sqrt()
}
