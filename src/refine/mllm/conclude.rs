//! From what was found to a refinement: whatever failed, every candidate has its place.

use super::describe::{Findings, Work};
use super::rank::Ranked;
use super::reason::Verdict;
use super::retry::CallError;
use super::{RefineError, Refinement};
use crate::milliseconds;
use whereabouts_core::Ranking;

/// Orders the candidates: those that could be compared as the model says, the others behind them in
/// coarse order. Without a verdict, all are in coarse order. `ranked` is `None` if there was nothing
/// to rank.
pub(super) fn conclude(
    work: &Work<'_>,
    findings: Findings,
    ranked: Option<Result<Ranked, CallError>>,
) -> Result<Refinement, RefineError> {
    let candidates = &work.record.candidates;
    let degraded = shortfalls(candidates.len(), &findings, ranked.as_ref());
    let ranked = ranked.and_then(Result::ok);
    let mut order = ranked.as_ref().map_or(Vec::new(), |ranked| ranked.verdict.order.clone());
    let behind: Vec<usize> = (0..candidates.len()).filter(|index| !order.contains(index)).collect();
    order.extend(behind);
    let ranking = Ranking::new(candidates, &order)
        .map_err(|error| RefineError::Permanent(error.to_string()))?;
    Ok(Refinement {
        descriptions: findings.described.iter().map(|pair| pair.of(candidates)).collect(),
        ranking,
        evidence: None,
        reasoning_took_ms: ranked.as_ref().map(|ranked| milliseconds(ranked.took)),
        reasoning: ranked.map(|ranked| ranked.verdict.reasoning),
        usage: work.usage(),
        degraded: (!degraded.is_empty()).then(|| degraded.join("; ")),
    })
}

/// What keeps the order from being the model's alone.
fn shortfalls(
    candidates: usize,
    findings: &Findings,
    ranked: Option<&Result<Ranked, CallError>>,
) -> Vec<String> {
    let Findings { described, failed } = findings;
    let mut found = Vec::new();
    let gone = candidates - described.len() - failed.len();
    if gone > 0 {
        found.push(format!("{gone} of {candidates} candidates were removed from the map"));
    }
    if let Some(error) = gravest(failed) {
        let count = failed.len();
        found.push(format!("{count} of {candidates} pairs could not be described: {error}"));
    }
    match ranked.map(|ranked| ranked.as_ref().map(|ranked| &ranked.verdict)) {
        Some(Ok(Verdict { left_out: 0, .. })) | None => {}
        Some(Ok(Verdict { left_out, .. })) => {
            found.push(format!("the model's ranking left out {left_out} candidates"));
        }
        Some(Err(error)) => found.push(format!("all candidates are in coarse order: {error}")),
    }
    found
}

/// The failure that decides what becomes of the job: one that keeps all calls from being made, else
/// one that may pass, else any.
pub(super) fn gravest(failed: &[CallError]) -> Option<CallError> {
    let weight = |error: &&CallError| match error {
        CallError::Permanent(_) => 0,
        CallError::Transient(_) => 1,
        CallError::JobSpent => 2,
        CallError::Suspended { .. } => 3,
        CallError::DaySpent => 4,
    };
    // The first of the gravest.
    failed.iter().rev().max_by_key(weight).cloned()
}

/// Whether no call may be made, whatever is asked.
pub(super) fn is_unavailable(error: &CallError) -> bool {
    matches!(error, CallError::Suspended { .. } | CallError::DaySpent | CallError::JobSpent)
}

/// The end of a job without a ranking.
pub(super) fn given_up(error: &CallError) -> RefineError {
    match error {
        CallError::Permanent(_) | CallError::JobSpent => RefineError::Permanent(error.to_string()),
        CallError::Transient(_) | CallError::Suspended { .. } | CallError::DaySpent => {
            RefineError::Transient(error.to_string())
        }
    }
}
