//! Parses the reasoning model's answer into an order of the candidates.
//!
//! The outcome is always a permutation of the candidates, whatever the model says.

use serde::Deserialize;
use serde_json::json;
use uuid::Uuid;

use super::wire::Schema;
use whereabouts_core::Digest;

/// Neutral names for the candidates.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Labels {
    /// The candidate of each label, in the order in which the prompt shows them.
    shown: Vec<usize>,
    labels: Vec<String>,
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
}

/// Why an answer cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AnswerError {
    /// It has neither a JSON object with a ranking nor a line with one.
    #[error("it holds no JSON object with a list \"ranking\"")]
    NoRanking,
    /// Its ranking names no candidate.
    #[error("its ranking holds none of the labels")]
    NoLabel,
}

#[derive(Deserialize)]
struct AnswerJson {
    #[serde(default)]
    reasoning: String,
    ranking: Vec<String>,
}

impl Labels {
    /// Labels the candidates, which are in coarse order, A, B, … With `shuffled_by`, their order in the
    /// prompt depends on the job's id alone, so that it is the same in every attempt.
    pub fn new(mut candidates: Vec<usize>, shuffled_by: Option<Uuid>) -> Self {
        if let Some(job) = shuffled_by {
            candidates
                .sort_by_cached_key(|index| Digest::of(format!("order {job} {index}").as_bytes()));
        }
        let labels = (0..candidates.len()).map(label).collect();
        Self { shown: candidates, labels }
    }

    /// Iterates over labels and candidates, in the order of the prompt.
    pub fn iter(&self) -> impl Iterator<Item = (&str, usize)> {
        self.labels.iter().map(String::as_str).zip(self.shown.iter().copied())
    }

    /// Returns the schema of an answer.
    pub fn schema(&self) -> Schema {
        let properties = json!({
            "reasoning": { "type": "string" },
            "ranking": { "type": "array", "items": { "type": "string", "enum": self.labels } },
        });
        Schema::object("ranking", properties)
    }

    /// Parses an answer. Unknown and repeated labels are skipped; missing candidates follow in coarse order.
    pub fn parse(&self, answer: &str) -> Result<Verdict, AnswerError> {
        let AnswerJson { reasoning, ranking } = find(answer).ok_or(AnswerError::NoRanking)?;
        let mut order = Vec::with_capacity(self.shown.len());
        for label in &ranking {
            match self.candidate(label) {
                Some(index) if !order.contains(&index) => order.push(index),
                _ => {}
            }
        }
        if order.is_empty() {
            return Err(AnswerError::NoLabel);
        }
        let mut missing: Vec<usize> =
            self.shown.iter().copied().filter(|index| !order.contains(index)).collect();
        missing.sort_unstable();
        let left_out = missing.len();
        order.extend(missing);
        Ok(Verdict { order, left_out, reasoning })
    }

    fn candidate(&self, label: &str) -> Option<usize> {
        let label = label.trim();
        let (_, index) = self.iter().find(|(known, _)| known.eq_ignore_ascii_case(label))?;
        Some(index)
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

/// The number of braces that are tried as the start of the answer.
const MAX_BRACES: usize = 1000;

/// Finds the answer in a text: the whole text, the inside of a code fence, the first suitable JSON object, or
/// a last line `RANKING: A, B, C`.
fn find(answer: &str) -> Option<AnswerJson> {
    let text = answer.trim();
    let fenced = || {
        let (_, after) = text.rsplit_once("```json")?;
        Some(after.split_once("```").map_or(after, |(inside, _)| inside))
    };
    let object = || {
        text.match_indices('{').take(MAX_BRACES).find_map(|(at, _)| {
            serde_json::Deserializer::from_str(&text[at..]).into_iter().next()?.ok()
        })
    };
    let parse = |text: &str| serde_json::from_str::<AnswerJson>(text.trim()).ok();
    parse(text).or_else(|| fenced().and_then(parse)).or_else(object).or_else(|| last_line(text))
}

fn last_line(text: &str) -> Option<AnswerJson> {
    let (before, line) = text.rsplit_once('\n').unwrap_or(("", text));
    let (head, list) = line.split_once(':')?;
    // Models often format it as bold text or as a heading.
    if !head.trim_matches([' ', '*', '#']).eq_ignore_ascii_case("ranking") {
        return None;
    }
    let ranking = list
        .split([',', '>'])
        .map(|label| label.trim_matches(|c: char| !c.is_alphanumeric()).to_owned())
        .collect();
    Some(AnswerJson { reasoning: before.trim().to_owned(), ranking })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(count: usize) -> Labels {
        Labels::new((0..count).collect(), None)
    }

    fn order(answer: &str) -> Result<(Vec<usize>, usize), AnswerError> {
        labels(4).parse(answer).map(|verdict| (verdict.order, verdict.left_out))
    }

    #[test]
    fn an_answer_is_found_in_any_of_its_formats() {
        let json = r#"{"reasoning": "a sign", "ranking": ["C", "A", "D", "B"]}"#;
        for answer in [
            json.to_owned(),
            format!("Here it is:\n```json\n{json}\n```\nDone."),
            format!("I think {json} is right"),
            format!("Not {{this}}, but {json}, as {{said}}"),
            "a sign\nRANKING: C, A, D, B".to_owned(),
            "a sign\n**Ranking:** C > A > D > B.".to_owned(),
        ] {
            let verdict = labels(4).parse(&answer).unwrap();
            assert_eq!((verdict.order, verdict.left_out), (vec![2, 0, 3, 1], 0), "{answer}");
        }
    }

    #[test]
    fn unknown_and_repeated_labels_are_skipped_and_missing_ones_follow_in_coarse_order() {
        let ranking = |list: &str| order(&format!(r#"{{"reasoning": "", "ranking": {list}}}"#));
        assert_eq!(ranking(r#"["D", "D", "X", "", "B", "d"]"#), Ok((vec![3, 1, 0, 2], 2)));
        assert_eq!(ranking(r#"["A", "B", "C", "D", "E"]"#), Ok((vec![0, 1, 2, 3], 0)));
        assert_eq!(ranking(r#"["X", "Y"]"#), Err(AnswerError::NoLabel));
        assert_eq!(ranking("[]"), Err(AnswerError::NoLabel));
    }

    #[test]
    fn a_text_without_a_ranking_is_an_error() {
        for answer in [
            "",
            "I cannot rank these.",
            "{}",
            "}{",
            r#"{"ranking": "A"}"#,
            r#"{"ranking": [1, 2]}"#,
            "A, B",
            "RANKING: A\nand so on",
            &"{".repeat(100_000),
        ] {
            assert_eq!(order(answer), Err(AnswerError::NoRanking), "{answer:.40}");
        }
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
        let verdict = labels.parse(r#"{"reasoning": "", "ranking": ["A"]}"#).unwrap();
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
