//! From descriptions and the model's order to a refinement. Whatever failed, the ranking contains every
//! candidate.

use whereabouts_core::Ranking;

use super::describe::DescribedPairs;
use super::rank::ModelRanking;
use super::reason::Verdict;
use super::retry::CallError;
use super::run::RefineRun;
use crate::{RefineError, Refinement, milliseconds};

/// Ranks the described candidates as the model does and puts the others behind them in coarse order. If
/// the model gave no ranking, all are in coarse order. `ranked` is `None` if there was nothing to rank.
pub(super) fn conclude(
    run: &RefineRun<'_>,
    pairs: DescribedPairs,
    ranked: Option<Result<ModelRanking, CallError>>,
) -> Result<Refinement, RefineError> {
    let candidates = &run.input.candidates;
    let degraded = shortfalls(candidates.len(), &pairs, ranked.as_ref());
    let ranked = ranked.and_then(Result::ok);
    let mut order = ranked.as_ref().map_or(Vec::new(), |ranked| ranked.verdict.order.clone());
    let behind: Vec<usize> = (0..candidates.len()).filter(|index| !order.contains(index)).collect();
    order.extend(behind);
    let ranking = Ranking::new(candidates, &order)
        .map_err(|error| RefineError::Permanent(error.to_string()))?;
    Ok(Refinement {
        descriptions: pairs.described.iter().map(|pair| pair.description(candidates)).collect(),
        ranking,
        evidence: None,
        reasoning_took_ms: ranked.as_ref().map(|ranked| milliseconds(ranked.took)),
        reasoning: ranked.map(|ranked| ranked.verdict.reasoning),
        usage: run.usage(),
        degraded: (!degraded.is_empty()).then(|| degraded.join("; ")),
    })
}

/// Returns the reasons why the order is not the model's alone.
fn shortfalls(
    candidates: usize,
    pairs: &DescribedPairs,
    ranked: Option<&Result<ModelRanking, CallError>>,
) -> Vec<String> {
    let DescribedPairs { described, failed } = pairs;
    let mut reasons = Vec::new();
    let gone = candidates - described.len() - failed.len();
    if gone > 0 {
        reasons.push(format!("{gone} of {candidates} candidates were removed from the map"));
    }
    if let Some(error) = most_serious(failed) {
        let count = failed.len();
        reasons.push(format!("{count} of {candidates} pairs could not be described: {error}"));
    }
    match ranked.map(|ranked| ranked.as_ref().map(|ranked| &ranked.verdict)) {
        Some(Ok(Verdict { left_out: 0, .. })) | None => {}
        Some(Ok(Verdict { left_out, .. })) => {
            reasons.push(format!("the model's ranking left out {left_out} candidates"));
        }
        Some(Err(error)) => reasons.push(format!("all candidates are in coarse order: {error}")),
    }
    reasons
}

/// Returns the error that decides the outcome of the job: preferably one that prevents all calls, then a
/// transient one, then any. Of equals, the first.
pub(super) fn most_serious(failed: &[CallError]) -> Option<CallError> {
    let weight = |error: &&CallError| match error {
        CallError::Permanent(_) => 0,
        CallError::Transient(_) => 1,
        CallError::JobSpent => 2,
        CallError::Suspended { .. } => 3,
        CallError::DaySpent => 4,
    };
    // `max_by_key` returns the last of equals.
    failed.iter().rev().max_by_key(weight).cloned()
}

/// Whether the error prevents all calls, whatever their content.
pub(super) fn is_unavailable(error: &CallError) -> bool {
    matches!(error, CallError::Suspended { .. } | CallError::DaySpent | CallError::JobSpent)
}

/// Converts the error of a job that has no ranking.
pub(super) fn failure(error: &CallError) -> RefineError {
    match error {
        CallError::Permanent(_) | CallError::JobSpent => RefineError::Permanent(error.to_string()),
        CallError::Transient(_) | CallError::Suspended { .. } | CallError::DaySpent => {
            RefineError::Transient(error.to_string())
        }
    }
}
