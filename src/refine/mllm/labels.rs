//! Neutral names for the candidates, and from the reasoning model's answer to an order of them.
//!
//! The outcome is always a permutation of the candidates, whatever the model says.

use uuid::Uuid;

use super::answer::{AnswerError, Reading, read};
use whereabouts_core::{Certainty, Digest};

/// Neutral names for the candidates.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Labels {
    /// The candidate of each label, in the order in which the prompt shows them.
    shown: Vec<usize>,
    names: Vec<String>,
}

/// A parsed answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// All labelled candidates, best first.
    pub order: Vec<usize>,
    /// The number of candidates that the answer left out. They come last, in coarse order.
    pub left_out: usize,
    /// The model's reasoning.
    pub reasoning: String,
    /// How sure the model is of the first candidate, if it says so.
    pub certainty: Option<Certainty>,
}

impl Labels {
    /// Labels the candidates, which are in coarse order, A, B, … With `shuffled_by`, their order in the
    /// prompt depends on the job's id alone, so that it is the same in every attempt.
    pub fn new(mut candidates: Vec<usize>, shuffled_by: Option<Uuid>) -> Self {
        if let Some(job) = shuffled_by {
            candidates
                .sort_by_cached_key(|index| Digest::of(format!("order {job} {index}").as_bytes()));
        }
        let names = (0..candidates.len()).map(label).collect();
        Self { shown: candidates, names }
    }

    /// Iterates over labels and candidates, in the order of the prompt.
    pub fn iter(&self) -> impl Iterator<Item = (&str, usize)> {
        self.names.iter().map(String::as_str).zip(self.shown.iter().copied())
    }

    /// Returns the labels.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Parses an answer. Unknown and repeated labels are skipped; ties are in coarse order, and missing candidates
    /// follow in coarse order. `cut` says that the answer was cut off.
    pub fn parse(&self, answer: &str, cut: bool) -> Result<Verdict, AnswerError> {
        let Reading { groups, left_out, reasoning, certainty } = read(answer, &self.names, cut)?;
        let mut order = Vec::with_capacity(self.shown.len());
        for group in groups {
            let known = group.iter().filter_map(|label| self.shown.get(*label).copied());
            let mut tied: Vec<usize> = known.collect();
            tied.sort_unstable();
            order.extend(tied);
        }
        let mut missing: Vec<usize> =
            self.shown.iter().copied().filter(|index| !order.contains(index)).collect();
        missing.sort_unstable();
        order.extend(missing);
        Ok(Verdict { order, left_out, reasoning, certainty })
    }
}

/// Returns A … Z, AA, AB, …
fn label(mut number: usize) -> String {
    let mut letters = Vec::new();
    loop {
        letters.push(char::from(b'A' + (number % 26) as u8));
        number = match (number / 26).checked_sub(1) {
            Some(rest) => rest,
            None => return letters.iter().rev().collect(),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(count: usize) -> Labels {
        Labels::new((0..count).collect(), None)
    }

    #[test]
    fn ties_and_missing_candidates_are_in_coarse_order() {
        let labels = Labels::new(vec![3, 1, 0, 2], None);
        let verdict =
            labels.parse(r#"{"reasoning": "r", "ranking": [["A", "C"], "D"]}"#, false).unwrap();
        assert_eq!((verdict.order, verdict.left_out), (vec![0, 3, 2, 1], 1));
        assert_eq!(verdict.reasoning, "r");
    }

    #[test]
    fn labels_do_not_leak_the_coarse_rank_and_are_the_same_in_every_attempt() {
        let job = Uuid::from_u128(7);
        let shuffled = |job| Labels::new((0..10).collect(), Some(job));
        assert_eq!(shuffled(job), shuffled(job));
        assert_ne!(shuffled(job).shown, (0..10).collect::<Vec<_>>());
        let firsts: std::collections::HashSet<usize> =
            (0..100).map(|job| shuffled(Uuid::from_u128(job)).shown[0]).collect();
        assert_eq!(firsts.len(), 10);
        let labels = shuffled(job);
        let (first, candidate) = labels.iter().next().unwrap();
        assert_eq!(first, "A");
        let verdict = labels.parse(r#"{"reasoning": "", "ranking": ["A"]}"#, false).unwrap();
        assert_eq!(verdict.order[0], candidate);
        assert!(verdict.order[1..].is_sorted());
    }

    #[test]
    fn a_hundred_candidates_have_a_hundred_labels() {
        let labels = labels(100);
        let unique: std::collections::HashSet<&str> =
            labels.iter().map(|(label, _)| label).collect();
        assert_eq!(unique.len(), 100);
        assert_eq!((label(25), label(26), label(99)), ("Z".into(), "AA".into(), "CV".into()));
    }
}
