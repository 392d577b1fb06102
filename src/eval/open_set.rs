//! Open-set metrics: how well the confidence in the first prediction separates known from unknown places.
//!
//! Two questions have one curve each. *Is the first prediction correct?* gives the precision-recall curve of
//! visual place recognition. *Is the place in the map at all?* tells an operator what `known` is worth: how many
//! of the frames called known are in the map, if 95 % of those in the map are called known.

use serde::{Deserialize, Serialize};

/// The first prediction for one query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TopPrediction {
    /// Its confidence.
    pub score: f64,
    /// Whether it is a correct reference.
    pub correct: bool,
    /// Whether the map has a correct reference.
    pub in_map: bool,
}

/// Precision and recall if predictions with at least this score are accepted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OperatingPoint {
    /// Lowest score that is accepted.
    pub threshold: f64,
    /// Fraction of the accepted predictions that are positive, 0 to 1.
    pub precision: f64,
    /// Fraction of the positives that are accepted, 0 to 1.
    pub recall: f64,
}

/// Computes a precision-recall curve by lowering the threshold; predictions of equal score are accepted together.
/// `positives` is the number of positives at best, which may be more than those among the predictions.
fn curve(
    predictions: &[TopPrediction],
    is_positive: impl Fn(&TopPrediction) -> bool,
    positives: usize,
) -> Vec<OperatingPoint> {
    let mut sorted = predictions.to_vec();
    sorted.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut points = Vec::new();
    let (mut accepted, mut true_positives) = (0_usize, 0_usize);
    for tied in sorted.chunk_by(|a, b| a.score == b.score) {
        accepted += tied.len();
        true_positives += tied.iter().filter(|prediction| is_positive(prediction)).count();
        points.push(OperatingPoint {
            threshold: tied[0].score,
            precision: true_positives as f64 / accepted as f64,
            recall: true_positives as f64 / positives.max(1) as f64,
        });
    }
    points
}

/// The curve of correct first predictions, relative to all queries that have a correct reference.
pub fn correctness_curve(predictions: &[TopPrediction]) -> Vec<OperatingPoint> {
    let in_map = predictions.iter().filter(|prediction| prediction.in_map).count();
    curve(predictions, |prediction| prediction.correct, in_map)
}

/// The curve of calling places known that are in the map.
pub fn known_curve(predictions: &[TopPrediction]) -> Vec<OperatingPoint> {
    let in_map = predictions.iter().filter(|prediction| prediction.in_map).count();
    curve(predictions, |prediction| prediction.in_map, in_map)
}

/// Returns the point of highest precision among those with at least this recall.
pub fn at_recall(curve: &[OperatingPoint], recall: f64) -> Option<OperatingPoint> {
    let sufficient = curve.iter().filter(|point| point.recall >= recall);
    sufficient.copied().max_by(|a, b| a.precision.total_cmp(&b.precision))
}

/// Returns the point at a threshold; `None` if nothing reaches it.
pub fn at_threshold(curve: &[OperatingPoint], threshold: f64) -> Option<OperatingPoint> {
    let last_accepted = curve.iter().rfind(|point| point.threshold >= threshold)?;
    Some(OperatingPoint { threshold, ..*last_accepted })
}

/// Returns the point of the highest F1, the harmonic mean of precision and recall (van Rijsbergen, 1979).
pub fn best_f1(curve: &[OperatingPoint]) -> Option<OperatingPoint> {
    let f1 = |point: &OperatingPoint| {
        2.0 * point.precision * point.recall
            / (point.precision + point.recall).max(f64::MIN_POSITIVE)
    };
    curve.iter().copied().max_by(|a, b| f1(a).total_cmp(&f1(b)))
}

/// Computes the area under the receiver operating characteristic (ROC): the probability that a place in the map
/// scores higher than one outside it, with ties counted as half (Mann and Whitney, 1947). `None` unless there are
/// both.
pub fn auc(predictions: &[TopPrediction]) -> Option<f64> {
    let (known, unknown): (Vec<&TopPrediction>, Vec<&TopPrediction>) =
        predictions.iter().partition(|prediction| prediction.in_map);
    if known.is_empty() || unknown.is_empty() {
        return None;
    }
    let wins = |known: &TopPrediction| -> f64 {
        let win = |unknown: &&TopPrediction| match known.score.total_cmp(&unknown.score) {
            std::cmp::Ordering::Greater => 1.0,
            std::cmp::Ordering::Equal => 0.5,
            std::cmp::Ordering::Less => 0.0,
        };
        unknown.iter().map(win).sum()
    };
    let sum: f64 = known.iter().map(|known| wins(known)).sum();
    Some(sum / (known.len() * unknown.len()) as f64)
}

/// Confidence thresholds for calling a place known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// The threshold of the service.
    pub service: f64,
    /// A second threshold to evaluate.
    pub requested: Option<f64>,
}

/// Fractions of the queries that are called known at a threshold, 0 to 1, by kind; `None` if there are no queries of
/// the kind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct KnownRates {
    /// Lowest confidence that is called known.
    pub threshold: f64,
    /// Of the correct first predictions.
    pub right: Option<f64>,
    /// Of the wrong first predictions for places in the map.
    pub wrong: Option<f64>,
    /// Of the places outside the map. The calibration promises at most 1 − threshold.
    pub unknown: Option<f64>,
}

impl KnownRates {
    /// Computes the fractions.
    pub fn at(predictions: &[TopPrediction], threshold: f64) -> Self {
        let rate = |is_kind: fn(&TopPrediction) -> bool| {
            let (all, known) = predictions.iter().filter(|prediction| is_kind(prediction)).fold(
                (0, 0),
                |(all, known), prediction| {
                    (all + 1, known + usize::from(prediction.score >= threshold))
                },
            );
            (all > 0).then(|| f64::from(known as u32) / f64::from(all))
        };
        Self {
            threshold,
            right: rate(|prediction| prediction.correct),
            wrong: rate(|prediction| prediction.in_map && !prediction.correct),
            unknown: rate(|prediction| !prediction.in_map),
        }
    }
}

/// Open-set metrics of one method.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OpenSetMetrics {
    /// How often the service calls queries of each kind known.
    pub called: KnownRates,
    /// The threshold with the best F1 for accepting correct predictions.
    pub suggested: Option<OperatingPoint>,
    /// Accepting correct predictions at the requested threshold.
    pub given: Option<OperatingPoint>,
    /// Queries of places outside the map.
    pub unknown: usize,
    /// Calling places known at a recall of 95 %; `None` without unknown places.
    pub at_95: Option<OperatingPoint>,
    /// Calling places known at a recall of 99 %; `None` without unknown places.
    pub at_99: Option<OperatingPoint>,
    /// Area under the ROC curve.
    pub auc: Option<f64>,
}

impl OpenSetMetrics {
    /// Computes the metrics.
    pub fn of(predictions: &[TopPrediction], thresholds: Thresholds) -> Self {
        let correctness = correctness_curve(predictions);
        let unknown = predictions.iter().filter(|prediction| !prediction.in_map).count();
        let known = if unknown > 0 { known_curve(predictions) } else { Vec::new() };
        let requested = thresholds.requested;
        Self {
            called: KnownRates::at(predictions, thresholds.service),
            suggested: best_f1(&correctness),
            given: requested.and_then(|threshold| at_threshold(&correctness, threshold)),
            unknown,
            at_95: at_recall(&known, 0.95),
            at_99: at_recall(&known, 0.99),
            auc: auc(predictions),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prediction(score: f64, correct: bool, in_map: bool) -> TopPrediction {
        TopPrediction { score, correct, in_map }
    }

    #[test]
    fn a_curve_is_in_descending_order_of_score_with_ties_in_one_point() {
        let predictions = [
            prediction(0.9, true, true),
            prediction(0.8, false, true),
            prediction(0.8, true, true),
            prediction(0.5, false, false),
        ];
        let curve = correctness_curve(&predictions);
        let point = |threshold, precision, recall| OperatingPoint { threshold, precision, recall };
        assert_eq!(
            curve,
            [
                point(0.9, 1.0, 1.0 / 3.0),
                point(0.8, 2.0 / 3.0, 2.0 / 3.0),
                point(0.5, 0.5, 2.0 / 3.0)
            ]
        );
        assert_eq!(best_f1(&curve).unwrap().threshold, 0.8);
        assert_eq!(at_threshold(&curve, 0.6), Some(point(0.6, 2.0 / 3.0, 2.0 / 3.0)));
        assert_eq!(at_threshold(&curve, 0.95), None);
        let known = known_curve(&predictions);
        assert_eq!(at_recall(&known, 0.95).unwrap(), point(0.8, 1.0, 1.0));
    }

    #[test]
    fn the_auc_is_the_fraction_of_ordered_pairs_with_ties_as_half() {
        let predictions = [
            prediction(0.9, true, true),
            prediction(0.4, true, true),
            prediction(0.5, false, false),
            prediction(0.4, false, false),
        ];
        // Of the four pairs, two are in order, one is a tie and one is not.
        assert_eq!(auc(&predictions), Some((1.0 + 1.0 + 0.0 + 0.5) / 4.0));
        assert_eq!(auc(&predictions[..2]), None);
    }

    #[test]
    fn known_rates_are_separate_for_correct_wrong_and_unknown() {
        let predictions = [
            prediction(0.9, true, true),
            prediction(0.4, true, true),
            prediction(0.95, false, true),
            prediction(0.1, false, true),
            prediction(0.2, false, true),
            prediction(0.2, false, true),
        ];
        let rates = KnownRates::at(&predictions, 0.9);
        assert_eq!((rates.right, rates.wrong, rates.unknown), (Some(0.5), Some(0.25), None));
    }
}
