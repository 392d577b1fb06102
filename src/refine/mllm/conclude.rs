//! From descriptions and an order to a refinement. Whatever failed, the ranking contains every candidate.

use whereabouts_core::{Agreement, Certainty, Evidence, Ranking, RefinerKind};

use super::describe::{DescribedPairs, UndescribedPair};
use super::labels::Verdict;
use super::rank::ModelRanking;
use super::retry::CallError;
use super::run::RefineRun;
use crate::{RefineError, Refinement, milliseconds};

/// Where the order of the described candidates comes from.
pub(super) enum Order {
    /// The model ranked them.
    Model(ModelRanking),
    /// The reasoning call failed, and another refiner ranked all candidates.
    Fallback {
        /// Its ranking.
        refinement: Box<Refinement>,
        /// Its name.
        by: RefinerKind,
        /// Why the model did not rank.
        why: CallError,
    },
    /// There is none, and why.
    Coarse(CallError),
    /// There is nothing to rank.
    Nothing,
}

/// Ranks the described candidates as the order says. The others keep their coarse place among them, and removed
/// ones come last.
pub(super) fn conclude(
    run: &RefineRun<'_>,
    pairs: &DescribedPairs,
    order: Order,
    agreement: Option<&Agreement>,
) -> Result<Refinement, RefineError> {
    let candidates = &run.input.candidates;
    let mut shortfalls = shortfalls(candidates.len(), pairs);
    let ranked = |order: &[usize]| {
        Ranking::new(candidates, &placed(candidates.len(), pairs, order))
            .map_err(|error| RefineError::Permanent(error.to_string()))
    };
    let coarse = Refinement {
        descriptions: pairs.described.iter().map(|pair| pair.description(candidates)).collect(),
        ranking: ranked(&[])?,
        evidence: None,
        certainty: None,
        agreement: agreement.cloned(),
        verdicts: Vec::new(),
        reasoning: None,
        reasoning_took_ms: None,
        ordered_by: None,
        usage: run.usage(),
        degraded: None,
    };
    let refinement = match order {
        Order::Model(ModelRanking { verdict, took }) => {
            let Verdict { order, left_out, reasoning, certainty } = verdict;
            let places = placed(candidates.len(), pairs, &order);
            // The model says nothing of a first candidate that keeps its coarse place.
            let certainty = certainty.filter(|_| places.first() == order.first());
            if left_out > 0 {
                shortfalls.push(format!("the model's ranking left out {left_out} candidates"));
            }
            Refinement {
                ranking: ranked(&order)?,
                evidence: evidence(agreement, places.first().copied(), certainty),
                certainty,
                reasoning_took_ms: Some(milliseconds(took)),
                reasoning: Some(reasoning),
                ..coarse
            }
        }
        Order::Fallback { refinement: other, by, why } => {
            shortfalls.push(format!(
                "the order is that of `{by}`, because the reasoning call failed ({why}); a retry of the job \
                 reasons again and buys no description again"
            ));
            shortfalls.extend(other.degraded.clone());
            let usage = coarse.usage + other.usage;
            Refinement { descriptions: coarse.descriptions, usage, ordered_by: Some(by), ..*other }
        }
        Order::Coarse(why) => {
            shortfalls.push(format!("all candidates are in coarse order: {why}"));
            coarse
        }
        Order::Nothing => coarse,
    };
    let degraded = (!shortfalls.is_empty()).then(|| shortfalls.join("; "));
    Ok(Refinement { degraded, ..refinement })
}

/// Returns the evidence of a verdict.
fn evidence(
    agreement: Option<&Agreement>,
    first: Option<usize>,
    certainty: Option<Certainty>,
) -> Option<Evidence> {
    if certainty == Some(Certainty::None) {
        return Some(Evidence::NONE_OF_THESE);
    }
    agreement?.verdict(first?, certainty)
}

/// Puts the described candidates, in their order or in coarse order, into the places that they have among all.
fn placed(candidates: usize, pairs: &DescribedPairs, order: &[usize]) -> Vec<usize> {
    let mut described: Vec<usize> = pairs.described.iter().map(|pair| pair.index).collect();
    described.sort_unstable();
    let failed: Vec<usize> = pairs.failed.iter().map(|pair| pair.index).collect();
    let mut next = if order.is_empty() { described.clone() } else { order.to_vec() }.into_iter();
    let present =
        (0..candidates).filter(|index| described.contains(index) || failed.contains(index));
    let mut placed: Vec<usize> = present
        .map(|index| if described.contains(&index) { next.next().unwrap_or(index) } else { index })
        .collect();
    let gone: Vec<usize> = (0..candidates).filter(|index| !placed.contains(index)).collect();
    placed.extend(gone);
    placed
}

/// Returns the reasons why not all candidates are described.
fn shortfalls(candidates: usize, pairs: &DescribedPairs) -> Vec<String> {
    let DescribedPairs { described, failed } = pairs;
    let mut reasons = Vec::new();
    let gone = candidates - described.len() - failed.len();
    if gone > 0 {
        reasons.push(format!("{gone} of {candidates} candidates were removed from the map"));
    }
    if let Some(error) = most_serious(failed) {
        let count = failed.len();
        reasons.push(format!(
            "{count} of {candidates} pairs could not be described and keep their coarse place: {error}"
        ));
    }
    reasons
}

/// Returns the error that decides the outcome of the job: preferably one that prevents all calls, then a
/// transient one, then any. Of equals, the first.
pub(super) fn most_serious(failed: &[UndescribedPair]) -> Option<CallError> {
    let weight = |pair: &&UndescribedPair| match pair.why {
        CallError::NoAnswer(_) => 0,
        CallError::Permanent(_) => 1,
        CallError::Transient(_) => 2,
        CallError::JobSpent => 3,
        CallError::Suspended { .. } => 4,
        CallError::Stopped { .. } => 5,
        CallError::DaySpent => 6,
    };
    // `max_by_key` returns the last of equals.
    failed.iter().rev().max_by_key(weight).map(|pair| pair.why.clone())
}

/// Converts the error of a job that has no ranking.
pub(super) fn failure(error: &CallError) -> RefineError {
    match error {
        CallError::Permanent(_) | CallError::NoAnswer(_) | CallError::JobSpent => {
            RefineError::Permanent(error.to_string())
        }
        CallError::Transient(_)
        | CallError::Stopped { .. }
        | CallError::Suspended { .. }
        | CallError::DaySpent => RefineError::Transient(error.to_string()),
    }
}
