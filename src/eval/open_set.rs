//! Known and unknown places: how well the confidence in the first answer tells them apart.
//!
//! Two questions, two curves. *Is the first answer true?* gives the precision-recall curve of visual
//! place recognition. *Is the place in the map at all?* gives what an operator wants of `known`:
//! which share of the frames called known are so, if 95 % of those that are so are called so.

use serde::{Deserialize, Serialize};

/// The first answer to one query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct First {
    /// How sure it is; higher is surer.
    pub score: f64,
    /// Whether it is a true reference.
    pub right: bool,
    /// Whether the map has a true reference.
    pub in_map: bool,
}

/// Precision and recall if answers that score at least this much are taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The least score that is taken.
    pub threshold: f64,
    /// Of those taken, the share that should be, 0 to 1.
    pub precision: f64,
    /// Of those that should be taken, the share that is, 0 to 1.
    pub recall: f64,
}

/// The curve of taking ever more answers, surest first; `wanted` says which should be taken and `all`
/// how many could be at best. Answers of equal score are taken together.
fn curve(first: &[First], wanted: impl Fn(&First) -> bool, all: usize) -> Vec<Point> {
    let mut sorted = first.to_vec();
    sorted.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut points = Vec::new();
    let (mut taken, mut good) = (0_usize, 0_usize);
    for tied in sorted.chunk_by(|a, b| a.score == b.score) {
        taken += tied.len();
        good += tied.iter().filter(|first| wanted(first)).count();
        points.push(Point {
            threshold: tied[0].score,
            precision: good as f64 / taken as f64,
            recall: good as f64 / all.max(1) as f64,
        });
    }
    points
}

/// Precision and recall of the first answers: which are true, of all queries that have a true
/// reference.
pub fn precision_recall(first: &[First]) -> Vec<Point> {
    let in_map = first.iter().filter(|first| first.in_map).count();
    curve(first, |first| first.right, in_map)
}

/// Precision and recall of calling places known.
pub fn knowing(first: &[First]) -> Vec<Point> {
    let in_map = first.iter().filter(|first| first.in_map).count();
    curve(first, |first| first.in_map, in_map)
}

/// The point of highest precision among those of at least this recall.
pub fn at_recall(curve: &[Point], recall: f64) -> Option<Point> {
    let enough = curve.iter().filter(|point| point.recall >= recall);
    enough.copied().max_by(|a, b| a.precision.total_cmp(&b.precision))
}

/// What is taken from this threshold on; `None` if nothing is.
pub fn at_threshold(curve: &[Point], threshold: f64) -> Option<Point> {
    let taken = curve.iter().rfind(|point| point.threshold >= threshold)?;
    Some(Point { threshold, ..*taken })
}

/// The point of the highest F1, the harmonic mean of precision and recall (van Rijsbergen, 1979).
pub fn best(curve: &[Point]) -> Option<Point> {
    let f1 = |point: &Point| {
        2.0 * point.precision * point.recall
            / (point.precision + point.recall).max(f64::MIN_POSITIVE)
    };
    curve.iter().copied().max_by(|a, b| f1(a).total_cmp(&f1(b)))
}

/// The area under the receiver operating characteristic: the chance that a place of the map scores
/// more than one that is not in it, ties counting half (Mann and Whitney, 1947). `None` unless there
/// are both.
pub fn auc(first: &[First]) -> Option<f64> {
    let (known, unknown): (Vec<&First>, Vec<&First>) = first.iter().partition(|f| f.in_map);
    if known.is_empty() || unknown.is_empty() {
        return None;
    }
    let wins = |known: &First| -> f64 {
        let one = |unknown: &&First| match known.score.total_cmp(&unknown.score) {
            std::cmp::Ordering::Greater => 1.0,
            std::cmp::Ordering::Equal => 0.5,
            std::cmp::Ordering::Less => 0.0,
        };
        unknown.iter().map(one).sum()
    };
    let sum: f64 = known.iter().map(|known| wins(known)).sum();
    Some(sum / (known.len() * unknown.len()) as f64)
}

/// Confidences from which places are called known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// The service's.
    pub service: f64,
    /// One to look at besides.
    pub given: Option<f64>,
}

/// What is called known from a threshold on, in shares from 0 to 1; `None` of nothing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Called {
    /// The least confidence.
    pub threshold: f64,
    /// Of the true first answers.
    pub right: Option<f64>,
    /// Of the false ones to queries whose place is in the map.
    pub wrong: Option<f64>,
    /// Of those to queries whose place is not in the map. The promise is at most 1 − threshold.
    pub unknown: Option<f64>,
}

impl Called {
    fn of(first: &[First], threshold: f64) -> Self {
        let share = |kind: fn(&First) -> bool| {
            let (all, known) = first
                .iter()
                .filter(|first| kind(first))
                .fold((0, 0), |(n, k), f| (n + 1, k + usize::from(f.score >= threshold)));
            (all > 0).then(|| f64::from(known as u32) / f64::from(all))
        };
        Self {
            threshold,
            right: share(|first| first.right),
            wrong: share(|first| first.in_map && !first.right),
            unknown: share(|first| !first.in_map),
        }
    }
}

/// What the first answers of a method say about `known`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OpenSetMetrics {
    /// What the service calls known.
    pub called: Called,
    /// The threshold with the best F1 of taking true answers.
    pub suggested: Option<Point>,
    /// Taking true answers at the threshold that was given.
    pub given: Option<Point>,
    /// Queries that are not in the map.
    pub unknown: usize,
    /// Calling places known at a recall of 95 %; without unknown places there is nothing to tell.
    pub at_95: Option<Point>,
    /// The same at 99 %.
    pub at_99: Option<Point>,
    /// Area under the receiver operating characteristic.
    pub auc: Option<f64>,
}

impl OpenSetMetrics {
    /// Works it out.
    pub fn of(first: &[First], Bounds { service, given }: Bounds) -> Self {
        let curve = precision_recall(first);
        let unknown = first.iter().filter(|first| !first.in_map).count();
        let knowing = if unknown > 0 { knowing(first) } else { Vec::new() };
        Self {
            called: Called::of(first, service),
            suggested: best(&curve),
            given: given.and_then(|threshold| at_threshold(&curve, threshold)),
            unknown,
            at_95: at_recall(&knowing, 0.95),
            at_99: at_recall(&knowing, 0.99),
            auc: auc(first),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn first(score: f64, right: bool, in_map: bool) -> First {
        First { score, right, in_map }
    }

    #[test]
    fn the_curve_takes_the_surest_first_and_ties_together() {
        let answers = [
            first(0.9, true, true),
            first(0.8, false, true),
            first(0.8, true, true),
            first(0.5, false, false),
        ];
        let points = precision_recall(&answers);
        let of = |threshold, precision, recall| Point { threshold, precision, recall };
        assert_eq!(
            points,
            [of(0.9, 1.0, 1.0 / 3.0), of(0.8, 2.0 / 3.0, 2.0 / 3.0), of(0.5, 0.5, 2.0 / 3.0)]
        );
        assert_eq!(best(&points).unwrap().threshold, 0.8);
        assert_eq!(at_threshold(&points, 0.6), Some(of(0.6, 2.0 / 3.0, 2.0 / 3.0)));
        assert_eq!(at_threshold(&points, 0.95), None);
        let known = knowing(&answers);
        assert_eq!(at_recall(&known, 0.95).unwrap(), of(0.8, 1.0, 1.0));
    }

    #[test]
    fn the_area_is_the_chance_of_the_right_order() {
        let answers = [
            first(0.9, true, true),
            first(0.4, true, true),
            first(0.5, false, false),
            first(0.4, false, false),
        ];
        // Of four pairs two are in order and one is a tie, twice over 0.5.
        assert_eq!(auc(&answers), Some((1.0 + 1.0 + 0.0 + 0.5) / 4.0));
        assert_eq!(auc(&answers[..2]), None);
    }

    #[test]
    fn what_is_called_known_is_told_by_kind() {
        let answers = [
            first(0.9, true, true),
            first(0.4, true, true),
            first(0.95, false, true),
            first(0.1, false, true),
            first(0.2, false, true),
            first(0.2, false, true),
        ];
        let called = Called::of(&answers, 0.9);
        assert_eq!((called.right, called.wrong, called.unknown), (Some(0.5), Some(0.25), None));
    }
}
