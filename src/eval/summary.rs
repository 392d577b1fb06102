//! The outcome of an evaluation in numbers.

use serde::{Deserialize, Serialize};

use super::open_set::{Bounds, First, OpenSetMetrics};
use super::recall::{AtK, Change, FirstTrue, change, first_true, recall};
use super::{Dataset, EvaluatedQuery, MethodOutcomes, Outcome, QueryKind};
use whereabouts_core::Usage;

/// What was measured, under which conditions.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summary {
    /// Queries that count in the recall.
    pub queries: usize,
    /// Queries without a true reference, left out of the recall.
    pub skipped: usize,
    /// Queries from places that are not in the map.
    pub unknown: usize,
    /// Images in the map.
    pub references: usize,
    /// The conditions.
    #[serde(flatten)]
    pub told: RunConditions,
    /// One for each method, a coarse one before those that refine it.
    pub methods: Vec<MethodSummary>,
}

/// The conditions of an evaluation.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RunConditions {
    /// The folder of references.
    pub database: String,
    /// The folder of queries.
    pub query_folder: String,
    /// What makes a reference true.
    pub truth: String,
    /// The model.
    pub model: String,
    /// Who runs it, and at which precision; descriptors differ a little between them.
    pub execution: String,
    /// Candidates that were refined.
    pub k: usize,
    /// The least confidence of a known place, if one was given.
    pub known_threshold: Option<f64>,
    /// From which confidence on the service calls a place known.
    pub known_confidence: f64,
    /// `fast` (a graph where the map is large) or `exact`.
    pub search: String,
}

/// How one method did.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct MethodSummary {
    /// Such as `gem` or `gem+local`.
    pub name: String,
    /// Recall@K in percent.
    pub recall: AtK<f64>,
    /// 95 % bootstrap intervals of the recall, in percent.
    pub interval: AtK<[f64; 2]>,
    /// What it changed about the coarse order; null for a coarse method.
    pub change: Option<Change>,
    /// How long the stages of a query took.
    pub timing_ms: Timing,
    /// What calls to a model outside cost.
    pub usage: Usage,
    /// Queries whose refined order is the coarse one, in part or in all.
    pub degraded: usize,
    /// Why the first of them is.
    pub degraded_why: Option<String>,
    /// Telling known places from unknown ones by the confidence in the first answer.
    pub known: OpenSetMetrics,
}

/// How long the stages of a query took, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Timing {
    /// Decoding and resizing.
    pub decode: Quantiles,
    /// Inference and pooling, the wait for a session included.
    pub extract: Quantiles,
    /// Search.
    pub search: Quantiles,
    /// Refinement of all pairs of a query; null for a coarse method.
    pub refine: Option<Quantiles>,
    /// The same for one pair.
    pub refine_pair: Option<Quantiles>,
}

/// Of a number that differs from query to query.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// The median.
    pub median: f64,
    /// The 95th percentile.
    pub p95: f64,
}

impl Summary {
    /// Sums up what was found. Methods come as coarse ones each followed by its refined ones.
    pub fn new(told: RunConditions, data: &Dataset, found: &[MethodOutcomes]) -> Self {
        let bounds = Bounds { service: told.known_confidence, given: told.known_threshold };
        let mut methods = Vec::with_capacity(found.len());
        let mut coarse = Vec::new();
        for method in found {
            let first = first_places(data, method);
            let is_coarse = method.method.refiner.is_none();
            let changed = (!is_coarse).then(|| change(&coarse, &first));
            methods.push(summed_up(data, method, &first, changed, bounds));
            if is_coarse {
                coarse = first;
            }
        }
        Self {
            queries: data.count(QueryKind::InMap),
            skipped: data.count(QueryKind::Skipped),
            unknown: data.count(QueryKind::Unknown),
            references: data.references.len(),
            told,
            methods,
        }
    }
}

/// The queries with their outcomes.
pub(super) fn visits<'a>(
    data: &'a Dataset,
    method: &'a MethodOutcomes,
) -> impl Iterator<Item = (&'a EvaluatedQuery, &'a Outcome)> {
    data.queries.iter().zip(&method.outcomes)
}

/// The place of the first true reference, for the queries that count.
fn first_places(data: &Dataset, method: &MethodOutcomes) -> Vec<FirstTrue> {
    visits(data, method)
        .filter(|(query, _)| query.kind == QueryKind::InMap)
        .map(|(query, outcome)| {
            first_true(outcome.answers.iter().map(|answer| &answer.image_id), &query.truth)
        })
        .collect()
}

/// The first answer to each query, of whatever kind.
pub(super) fn firsts(data: &Dataset, method: &MethodOutcomes) -> Vec<First> {
    visits(data, method)
        .filter_map(|(query, outcome)| {
            let answer = outcome.answers.first()?;
            Some(First {
                score: f64::from(outcome.confidence),
                right: query.truth.contains(&answer.image_id),
                in_map: query.kind == QueryKind::InMap,
            })
        })
        .collect()
}

fn summed_up(
    data: &Dataset,
    found: &MethodOutcomes,
    first: &[FirstTrue],
    change: Option<Change>,
    bounds: Bounds,
) -> MethodSummary {
    let recall = recall(first);
    let outcomes = &found.outcomes;
    let spread = |of: fn(&Outcome) -> f64| Quantiles::of(outcomes.iter().map(of).collect());
    let is_refined = found.method.refiner.is_some();
    MethodSummary {
        name: found.method.name(),
        recall: recall.at,
        interval: recall.interval,
        change,
        timing_ms: Timing {
            decode: spread(|outcome| outcome.times.decode),
            extract: spread(|outcome| outcome.times.extract),
            search: spread(|outcome| outcome.times.search),
            refine: is_refined.then(|| spread(|outcome| outcome.times.refine)),
            refine_pair: is_refined.then(|| {
                spread(|outcome| outcome.times.refine / outcome.times.pairs.max(1) as f64)
            }),
        },
        usage: outcomes.iter().fold(Usage::default(), |sum, outcome| sum + outcome.usage),
        degraded: outcomes.iter().filter(|outcome| outcome.degraded.is_some()).count(),
        degraded_why: outcomes.iter().find_map(|outcome| outcome.degraded.clone()),
        known: OpenSetMetrics::of(&firsts(data, found), bounds),
    }
}

impl Quantiles {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            let place = (share * values.len().saturating_sub(1) as f64).round() as usize;
            values.get(place).copied().unwrap_or_default()
        };
        Self { median: at(0.5), p95: at(0.95) }
    }
}
