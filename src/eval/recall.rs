//! Recall@K, and what a refinement changed.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};

use super::resample::interval;
use whereabouts_core::ImageId;

/// One number for each K of the field's tables.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct AtK<T> {
    /// For the first image.
    #[serde(rename = "1")]
    pub one: T,
    /// For the first 5.
    #[serde(rename = "5")]
    pub five: T,
    /// For the first 10.
    #[serde(rename = "10")]
    pub ten: T,
}

impl<T> AtK<T> {
    /// The number for each K.
    pub fn of(mut number: impl FnMut(usize) -> T) -> Self {
        Self { one: number(1), five: number(5), ten: number(10) }
    }
}

/// The place of the first true reference among the answers of one query, from 1; `None` if there is
/// none. All recalls follow from it.
pub type FirstTrue = Option<usize>;

/// Finds the first true reference.
pub fn first_true<'a>(
    answers: impl IntoIterator<Item = &'a ImageId>,
    truth: &HashSet<ImageId>,
) -> FirstTrue {
    answers.into_iter().position(|id| truth.contains(id)).map(|place| place + 1)
}

/// Whether a query counts as right at K: one of its first K answers is a true reference.
fn right(first: FirstTrue, k: usize) -> f64 {
    if first.is_some_and(|place| place <= k) { 1.0 } else { 0.0 }
}

/// The share of queries with a true reference among the first K answers, in percent, with the 95 %
/// bootstrap interval of each.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recall {
    /// In percent.
    pub at: AtK<f64>,
    /// 95 % intervals, `[low, high]` in percent.
    pub interval: AtK<[f64; 2]>,
}

/// Recall of queries that all have a true reference.
pub fn recall(queries: &[FirstTrue]) -> Recall {
    let values = |k| queries.iter().map(|first| right(*first, k)).collect::<Vec<f64>>();
    Recall { at: AtK::of(|k| mean(&values(k))), interval: AtK::of(|k| bounds(&values(k))) }
}

/// What a refinement did to the queries, by whether the first answer is right.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Change {
    /// Difference of the recalls, in percentage points.
    pub recall: AtK<f64>,
    /// 95 % intervals of the differences, paired by query, in percentage points.
    pub interval: AtK<[f64; 2]>,
    /// Queries that were wrong before and right after.
    pub helped: usize,
    /// Queries that were right before and wrong after.
    pub harmed: usize,
    /// All others.
    pub left_alone: usize,
}

/// Compares the answers to the same queries, in the same order.
pub fn change(before: &[FirstTrue], after: &[FirstTrue]) -> Change {
    let pairs = || before.iter().zip(after);
    let differences =
        |k| pairs().map(|(before, after)| right(*after, k) - right(*before, k)).collect::<Vec<_>>();
    let count = |kind: f64| differences(1).into_iter().filter(|change| *change == kind).count();
    Change {
        recall: AtK::of(|k| mean(&differences(k))),
        interval: AtK::of(|k| bounds(&differences(k))),
        helped: count(1.0),
        harmed: count(-1.0),
        left_alone: count(0.0),
    }
}

/// In percent.
fn mean(values: &[f64]) -> f64 {
    100.0 * values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// In percent.
fn bounds(values: &[f64]) -> [f64; 2] {
    interval(values).map_or([0.0; 2], |range| [range.start, range.end].map(|x| 100.0 * x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recall_counts_the_first_true_reference() {
        let recall = recall(&[Some(1), Some(3), None, Some(10)]);
        assert_eq!(recall.at, AtK { one: 25.0, five: 50.0, ten: 75.0 });
        assert!(recall.interval.one[0] <= 25.0 && recall.interval.one[1] >= 25.0);
    }

    #[test]
    fn a_change_tells_help_from_harm() {
        let before = [Some(1), Some(2), None, Some(1)];
        let after = [Some(2), Some(1), None, Some(1)];
        let change = change(&before, &after);
        assert_eq!((change.helped, change.harmed, change.left_alone), (1, 1, 2));
        assert_eq!(change.recall, AtK { one: 0.0, five: 0.0, ten: 0.0 });
    }
}
