//! The results of an evaluation as numbers.

use serde::{Deserialize, Serialize};

use super::open_set::{KnownRates, OpenSetMetrics, Thresholds, TopPrediction};
use super::recall::{AtK, Change, FirstCorrectRank, change, first_correct_rank, recall};
use super::{
    AlternativeConfidence, Dataset, EvaluatedQuery, LeftOut, MethodOutcomes, QueryKind,
    QueryOutcome,
};
use whereabouts_core::Usage;

/// The results of an evaluation and the conditions under which they were measured.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summary {
    /// Queries that count in the recall.
    pub queries: usize,
    /// Queries without a correct reference or without a position, left out of the recall.
    pub skipped: usize,
    /// Queries of places outside the map.
    pub unknown: usize,
    /// Images in the map.
    pub references: usize,
    /// What of the folders is not evaluated, and why.
    #[serde(default)]
    pub left_out: LeftOut,
    /// The conditions.
    #[serde(flatten)]
    pub conditions: RunConditions,
    /// One summary per method; a coarse method is followed by those that refine it.
    pub methods: Vec<MethodSummary>,
}

/// The conditions of an evaluation.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RunConditions {
    /// The folder of references.
    pub database: String,
    /// The folder of queries.
    pub query_folder: String,
    /// When a reference is correct, see [`TruthSource::criterion`](crate::TruthSource::criterion).
    pub truth: String,
    /// The model.
    pub model: String,
    /// Execution provider and precision of the model; descriptors differ slightly between them.
    pub execution: String,
    /// Candidates that were refined.
    pub k: usize,
    /// Threshold for known places that was requested, if any.
    pub known_threshold: Option<f64>,
    /// Confidence from which the service calls a place known.
    pub known_confidence: f64,
    /// `fast` (the graph, if the map is large) or `exact`.
    pub search: String,
}

/// The results of one method.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MethodSummary {
    /// Name of the method, such as `gem` or `gem+local`.
    pub name: String,
    /// Recall@K in percent.
    pub recall: AtK<f64>,
    /// 95 % bootstrap intervals of the recall, in percent.
    pub interval: AtK<[f64; 2]>,
    /// Change against the coarse method; `None` for a coarse method.
    pub change: Option<Change>,
    /// Duration of the stages of a query.
    pub timing_ms: Timing,
    /// Calls and tokens spent on an external model.
    pub usage: Usage,
    /// Queries whose refined ranking is the coarse one, in part or as a whole.
    pub degraded: usize,
    /// The reason for the first of them.
    pub degraded_why: Option<String>,
    /// How well the confidence separates known from unknown places.
    pub known: OpenSetMetrics,
    /// How often queries would be called known by another confidence; only of a method that asks a model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alternatives: Option<KnownAlternatives>,
}

/// How often queries would be called known by another confidence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct KnownAlternatives {
    /// By the similarity of the first answer.
    pub similarity: KnownRates,
    /// By the model's certainty, taken at its word.
    pub stated: KnownRates,
}

/// Duration of the stages of a query, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Timing {
    /// Decoding and resizing.
    pub decode: Quantiles,
    /// Inference and pooling, including the wait for a session.
    pub extract: Quantiles,
    /// Search.
    pub search: Quantiles,
    /// Refinement of all pairs of a query; `None` for a coarse method.
    pub refine: Option<Quantiles>,
    /// Refinement of one pair; `None` for a coarse method.
    pub refine_pair: Option<Quantiles>,
}

/// Median and 95th percentile of a per-query value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// The median.
    pub median: f64,
    /// The 95th percentile.
    pub p95: f64,
}

impl Summary {
    /// Computes the results. Each coarse method must be followed by those that refine it.
    pub fn new(conditions: RunConditions, data: &Dataset, outcomes: &[MethodOutcomes]) -> Self {
        let thresholds = Thresholds {
            service: conditions.known_confidence,
            requested: conditions.known_threshold,
        };
        let mut methods = Vec::with_capacity(outcomes.len());
        let mut coarse = Vec::new();
        for method in outcomes {
            let ranks = first_correct_ranks(data, method);
            let is_coarse = method.method.refiner.is_none();
            let change = (!is_coarse).then(|| change(&coarse, &ranks));
            methods.push(summarize_method(data, method, &ranks, change, thresholds));
            if is_coarse {
                coarse = ranks;
            }
        }
        Self {
            queries: data.count(QueryKind::InMap),
            skipped: data.count(QueryKind::Skipped) + data.left_out.queries.len(),
            unknown: data.count(QueryKind::Unknown),
            references: data.references.len(),
            left_out: data.left_out.clone(),
            conditions,
            methods,
        }
    }
}

/// Pairs the queries with their outcomes.
pub(super) fn query_outcomes<'a>(
    data: &'a Dataset,
    method: &'a MethodOutcomes,
) -> impl Iterator<Item = (&'a EvaluatedQuery, &'a QueryOutcome)> {
    data.queries.iter().zip(&method.outcomes)
}

/// Returns the rank of the first correct reference of each query that counts in the recall.
fn first_correct_ranks(data: &Dataset, method: &MethodOutcomes) -> Vec<FirstCorrectRank> {
    query_outcomes(data, method)
        .filter(|(query, _)| query.kind == QueryKind::InMap)
        .map(|(query, outcome)| {
            let ids = outcome.predictions.iter().map(|prediction| &prediction.image_id);
            first_correct_rank(ids, &query.truth)
        })
        .collect()
}

/// Returns the first prediction of each query, of every kind.
pub(super) fn top_predictions(data: &Dataset, method: &MethodOutcomes) -> Vec<TopPrediction> {
    scored(data, method, |outcome| outcome.confidence.unwrap_or_default())
}

fn scored(
    data: &Dataset,
    method: &MethodOutcomes,
    score: impl Fn(&QueryOutcome) -> f32,
) -> Vec<TopPrediction> {
    query_outcomes(data, method)
        .filter_map(|(query, outcome)| {
            let prediction = outcome.predictions.first()?;
            Some(TopPrediction {
                score: f64::from(score(outcome)),
                correct: query.truth.contains(&prediction.image_id),
                in_map: query.kind == QueryKind::InMap,
            })
        })
        .collect()
}

fn summarize_method(
    data: &Dataset,
    method: &MethodOutcomes,
    ranks: &[FirstCorrectRank],
    change: Option<Change>,
    thresholds: Thresholds,
) -> MethodSummary {
    let recall = recall(ranks);
    let outcomes = &method.outcomes;
    let quantiles =
        |value: fn(&QueryOutcome) -> f64| Quantiles::of(outcomes.iter().map(value).collect());
    let is_refined = method.method.refiner.is_some();
    MethodSummary {
        name: method.method.name(),
        recall: recall.at,
        interval: recall.interval,
        change,
        timing_ms: Timing {
            decode: quantiles(|outcome| outcome.times.decode),
            extract: quantiles(|outcome| outcome.times.extract),
            search: quantiles(|outcome| outcome.times.search),
            refine: is_refined.then(|| quantiles(|outcome| outcome.times.refine)),
            refine_pair: is_refined.then(|| {
                quantiles(|outcome| outcome.times.refine / outcome.times.pairs.max(1) as f64)
            }),
        },
        usage: outcomes.iter().fold(Usage::default(), |sum, outcome| sum + outcome.usage),
        degraded: outcomes.iter().filter(|outcome| outcome.degraded.is_some()).count(),
        degraded_why: outcomes.iter().find_map(|outcome| outcome.degraded.clone()),
        known: OpenSetMetrics::of(&top_predictions(data, method), thresholds),
        alternatives: outcomes.iter().any(|outcome| outcome.alternatives.is_some()).then(|| {
            let rates = |of: fn(AlternativeConfidence) -> f32| {
                // A query that the model did not rank has the confidence of its coarse answer.
                let score = |outcome: &QueryOutcome| {
                    outcome.alternatives.map(of).or(outcome.confidence).unwrap_or_default()
                };
                KnownRates::at(&scored(data, method, score), thresholds.service)
            };
            KnownAlternatives {
                similarity: rates(|alternatives| alternatives.similarity),
                stated: rates(|alternatives| alternatives.stated),
            }
        }),
    }
}

impl Quantiles {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let quantile = |share: f64| {
            let index = (share * values.len().saturating_sub(1) as f64).round() as usize;
            values.get(index).copied().unwrap_or_default()
        };
        Self { median: quantile(0.5), p95: quantile(0.95) }
    }
}
