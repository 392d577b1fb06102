//! Recall@K, and how refinement changed it.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};

use super::resample::interval;
use whereabouts_core::ImageId;

/// One value for each K that the field reports.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct AtK<T> {
    /// K = 1.
    #[serde(rename = "1")]
    pub one: T,
    /// K = 5.
    #[serde(rename = "5")]
    pub five: T,
    /// K = 10.
    #[serde(rename = "10")]
    pub ten: T,
}

impl<T> AtK<T> {
    /// Computes the value for each K.
    pub fn of(mut value: impl FnMut(usize) -> T) -> Self {
        Self { one: value(1), five: value(5), ten: value(10) }
    }
}

/// Rank of the first correct reference among the predictions of one query, from 1; `None` if none is correct. All
/// recalls follow from it.
pub type FirstCorrectRank = Option<usize>;

/// Finds the rank of the first correct reference.
pub fn first_correct_rank<'a>(
    predictions: impl IntoIterator<Item = &'a ImageId>,
    truth: &HashSet<ImageId>,
) -> FirstCorrectRank {
    predictions.into_iter().position(|id| truth.contains(id)).map(|index| index + 1)
}

/// 1 if one of the first K predictions is correct, otherwise 0.
fn correct_at(rank: FirstCorrectRank, k: usize) -> f64 {
    if rank.is_some_and(|rank| rank <= k) { 1.0 } else { 0.0 }
}

/// Percentage of queries with a correct reference among the first K predictions, with 95 % bootstrap intervals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recall {
    /// In percent.
    pub at: AtK<f64>,
    /// 95 % intervals, `[low, high]` in percent.
    pub interval: AtK<[f64; 2]>,
}

/// Computes the recall of queries that all have a correct reference.
pub fn recall(queries: &[FirstCorrectRank]) -> Recall {
    let values = |k| queries.iter().map(|rank| correct_at(*rank, k)).collect::<Vec<f64>>();
    Recall { at: AtK::of(|k| mean(&values(k))), interval: AtK::of(|k| bounds(&values(k))) }
}

/// The effect of refinement on the recall and on single queries.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Change {
    /// Difference of the recalls, in percentage points.
    pub recall: AtK<f64>,
    /// 95 % intervals of the differences, paired by query, in percentage points.
    pub interval: AtK<[f64; 2]>,
    /// Queries whose first prediction was wrong before and is correct after.
    pub helped: usize,
    /// Queries whose first prediction was correct before and is wrong after.
    pub harmed: usize,
    /// All other queries.
    pub left_alone: usize,
}

/// Compares two methods on the same queries in the same order.
pub fn change(before: &[FirstCorrectRank], after: &[FirstCorrectRank]) -> Change {
    let pairs = || before.iter().zip(after);
    let differences = |k| {
        pairs()
            .map(|(before, after)| correct_at(*after, k) - correct_at(*before, k))
            .collect::<Vec<_>>()
    };
    let count = |difference: f64| differences(1).into_iter().filter(|d| *d == difference).count();
    Change {
        recall: AtK::of(|k| mean(&differences(k))),
        interval: AtK::of(|k| bounds(&differences(k))),
        helped: count(1.0),
        harmed: count(-1.0),
        left_alone: count(0.0),
    }
}

/// The mean, in percent.
fn mean(values: &[f64]) -> f64 {
    100.0 * values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// The bootstrap interval, in percent.
fn bounds(values: &[f64]) -> [f64; 2] {
    interval(values).map_or([0.0; 2], |range| [range.start, range.end].map(|x| 100.0 * x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recall_counts_queries_whose_first_correct_rank_is_at_most_k() {
        let recall = recall(&[Some(1), Some(3), None, Some(10)]);
        assert_eq!(recall.at, AtK { one: 25.0, five: 50.0, ten: 75.0 });
        assert!(recall.interval.one[0] <= 25.0 && recall.interval.one[1] >= 25.0);
    }

    #[test]
    fn a_change_counts_helped_and_harmed_queries() {
        let before = [Some(1), Some(2), None, Some(1)];
        let after = [Some(2), Some(1), None, Some(1)];
        let change = change(&before, &after);
        assert_eq!((change.helped, change.harmed, change.left_alone), (1, 1, 2));
        assert_eq!(change.recall, AtK { one: 0.0, five: 0.0, ten: 0.0 });
    }
}
