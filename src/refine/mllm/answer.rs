//! Finds the answer in what the reasoning model wrote. A pure function of its text: no answer is trusted.
//!
//! The last complete answer counts, because drafts, quoted templates and quoted signs come before it.

use whereabouts_core::Certainty;

use super::loose_json::{FoundValue, Loose, value_at, values};
use super::order::{Groups, Order, in_text, label, order, plain};

/// What an answer says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reading {
    /// Labels by their number, best first; those of one group are tied.
    pub groups: Groups,
    /// The number of labels that it leaves out.
    pub left_out: usize,
    /// The reasoning; may be empty.
    pub reasoning: String,
    /// How sure the model is, if it says so.
    pub certainty: Option<Certainty>,
}

/// Why an answer cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AnswerError {
    /// There is no ranking in it.
    #[error("it holds no JSON object with a list \"ranking\"")]
    NoRanking,
    /// Its ranking names no candidate.
    #[error("its ranking holds none of the labels")]
    NoLabel,
    /// It can be read in more than one way.
    #[error("its ranking can be read in more than one way")]
    Ambiguous,
}

/// Keys of the ranking, without case and punctuation, the likeliest first.
const RANKING_KEYS: [&str; 10] = [
    "ranking",
    "rankings",
    "finalranking",
    "ranked",
    "rankedcandidates",
    "rankedlabels",
    "rankingorder",
    "ranks",
    "order",
    "rank",
];
const REASONING_KEYS: [&str; 6] =
    ["reasoning", "reason", "explanation", "rationale", "analysis", "thinking"];

/// How far an object may be nested in another.
const MAX_DEPTH: usize = 6;

/// Characters after a draft of an answer that was cut off.
const TAIL: usize = 20;

/// An order that was found in the text.
struct Draft {
    order: Order,
    reasoning: String,
    certainty: Option<Certainty>,
    /// The byte after it.
    end: usize,
    /// Objects with a ranking count more than lists and lines.
    is_object: bool,
}

impl Draft {
    fn is_complete(&self, labels: &[String]) -> bool {
        self.labelled() == labels.len()
    }

    fn labelled(&self) -> usize {
        match &self.order {
            Order::Labels(groups) => groups.iter().map(Vec::len).sum(),
            Order::Ambiguous | Order::Nothing => 0,
        }
    }

    fn reading(self, labels: &[String]) -> Reading {
        let left_out = labels.len() - self.labelled();
        let Self { order, reasoning, certainty, .. } = self;
        let groups = if let Order::Labels(groups) = order { groups } else { Vec::new() };
        Reading { groups, left_out, reasoning, certainty }
    }
}

/// Reads the answer. `cut` says that the text was cut off at its end, so that a draft may be all there is.
pub fn read(text: &str, labels: &[String], cut: bool) -> Result<Reading, AnswerError> {
    let inner = serde_json::from_str::<String>(text.trim()).ok();
    let text = inner.as_deref().unwrap_or(text);
    let found = values(text);
    let mut drafts: Vec<Draft> = found.iter().flat_map(|found| of_value(found, labels)).collect();
    if !drafts.iter().any(|draft| draft.is_object) {
        drafts.extend(of_fragment(text, labels));
    }
    drafts.extend(of_lines(text, labels));
    let best = |is_object: bool| {
        let fits = |draft: &&Draft| draft.is_object == is_object && draft.is_complete(labels);
        drafts.iter().filter(fits).max_by_key(|draft| draft.end)
    };
    let Some(chosen) = best(true).or_else(|| best(false)) else { return partial(drafts, labels) };
    let end = chosen.end;
    let differs =
        |draft: &Draft| draft.end > end && draft.is_complete(labels) && draft.order != chosen.order;
    if drafts.iter().any(differs) || (cut && text[end..].trim().chars().count() > TAIL) {
        return Err(AnswerError::Ambiguous);
    }
    let is_chosen = |draft: &Draft| std::ptr::eq(draft, chosen);
    match drafts.iter().position(is_chosen) {
        Some(index) => Ok(drafts.swap_remove(index).reading(labels)),
        None => Err(AnswerError::NoRanking),
    }
}

/// Returns the last object that ranks a part of the labels.
fn partial(mut drafts: Vec<Draft>, labels: &[String]) -> Result<Reading, AnswerError> {
    drafts.retain(|draft| draft.is_object);
    let last = drafts.into_iter().max_by_key(|draft| draft.end);
    match last {
        None => Err(AnswerError::NoRanking),
        Some(Draft { order: Order::Nothing, .. }) => Err(AnswerError::NoLabel),
        Some(Draft { order: Order::Ambiguous, .. }) => Err(AnswerError::Ambiguous),
        Some(draft) => Ok(draft.reading(labels)),
    }
}

/// Returns the drafts in a value: objects with a ranking, or else an order of all labels.
fn of_value(found: &FoundValue, labels: &[String]) -> Vec<Draft> {
    let mut drafts = Vec::new();
    collect(&found.value, labels, found.end, 0, &mut drafts);
    if drafts.is_empty() {
        drafts.extend(bare(order(&found.value, labels), found.end));
    }
    drafts
}

fn bare(order: Order, end: usize) -> Option<Draft> {
    let is_order = matches!(order, Order::Labels(_));
    is_order.then(|| Draft {
        order,
        reasoning: String::new(),
        certainty: None,
        end,
        is_object: false,
    })
}

/// Collects objects with a ranking, also from inside others: some models fill in the schema or wrap the answer.
fn collect(value: &Loose, labels: &[String], end: usize, depth: usize, drafts: &mut Vec<Draft>) {
    if depth > MAX_DEPTH {
        return;
    }
    let members = match value {
        Loose::Object(members) => members,
        Loose::List(items) => {
            return items.iter().for_each(|item| collect(item, labels, end, depth + 1, drafts));
        }
        _ => return,
    };
    let of = |keys: &[&str]| {
        keys.iter()
            .find_map(|wanted| members.iter().find(|(key, _)| plain(key) == *wanted))
            .map(|(_, value)| value)
    };
    let ranking =
        of(&RANKING_KEYS).filter(|value| !matches!(value, Loose::Number(_) | Loose::Bool(_)));
    // The schema itself has an object there, which describes a list.
    let is_schema = matches!(ranking, Some(Loose::Object(members))
        if members.iter().any(|(key, _)| key == "type" || key == "items"));
    if let Some(ranking) = ranking.filter(|_| !is_schema) {
        let certainty = members.iter().find(|(key, _)| plain(key) == "certainty");
        drafts.push(Draft {
            order: order(ranking, labels),
            reasoning: of(&REASONING_KEYS).map(as_text).unwrap_or_default(),
            certainty: certainty.and_then(|(_, value)| certainty_of(value)),
            end,
            is_object: true,
        });
        return;
    }
    for (key, value) in members {
        match value {
            Loose::Text(text) if matches!(plain(key).as_str(), "arguments" | "parameters") => {
                if let Some(inner) = value_at(text.trim()) {
                    collect(&inner, labels, end, depth + 1, drafts);
                }
            }
            value => collect(value, labels, end, depth + 1, drafts),
        }
    }
}

/// Returns what follows the last key `ranking` in a text whose objects cannot be read.
fn of_fragment(text: &str, labels: &[String]) -> Option<Draft> {
    let lower = text.to_ascii_lowercase();
    let at = lower.rfind("\"ranking\"")?;
    let after = text[at + "\"ranking\"".len()..].trim_start().strip_prefix(':')?.trim_start();
    let list = after.starts_with(['[', '{']).then(|| value_at(after))??;
    let order = Some(order(&list, labels)).filter(|order| *order != Order::Nothing)?;
    let begins = lower[..at].rfind("\"reasoning\"").map(|begins| begins + "\"reasoning\"".len());
    let reasoning = begins.map(|begins| {
        let around: &[char] = &[' ', '\n', ':', ',', '"'];
        text[begins..at].trim_matches(around).to_owned()
    });
    Some(Draft {
        order,
        reasoning: reasoning.unwrap_or_default(),
        certainty: None,
        end: text.len() - after.len(),
        is_object: true,
    })
}

/// Returns the orders in lines: `RANKING: A, B`, `A > B`, or a numbered list.
fn of_lines(text: &str, labels: &[String]) -> Vec<Draft> {
    let mut drafts = Vec::new();
    let mut numbered: Vec<usize> = Vec::new();
    let mut end = 0;
    for line in text.split_inclusive('\n') {
        let start = end;
        end += line.len();
        let line = line.trim();
        match numbered_label(line, numbered.len() + 1, labels) {
            Some(known) => {
                numbered.push(known);
                let groups = numbered.iter().map(|known| vec![*known]).collect();
                drafts.extend(bare(Order::Labels(groups), end));
                continue;
            }
            None if line.is_empty() => continue,
            None => numbered.clear(),
        }
        let list = match line.split_once(':') {
            Some((head, list)) if is_heading(head) => Some(list),
            Some(_) => None,
            None => Some(line).filter(|line| line.contains('>')),
        };
        let list = list.map(|list| list.trim_matches(|c: char| !c.is_alphanumeric()));
        let order = list.map(|list| in_text(list, labels, true));
        let draft = order.and_then(|order| bare(order, end));
        let before = || text[..start].trim().to_owned();
        drafts.extend(draft.map(|draft| Draft { reasoning: before(), ..draft }));
    }
    drafts
}

/// Models often format the heading as bold text.
fn is_heading(head: &str) -> bool {
    let head = plain(head);
    matches!(
        head.as_str(),
        "ranking" | "finalranking" | "rank" | "order" | "finalanswer" | "answer"
    )
}

/// Returns the label in line `number` of a numbered list.
fn numbered_label(line: &str, number: usize, labels: &[String]) -> Option<usize> {
    let line = line.trim_start_matches(['*', '#', '-', ' ']);
    let rest = line.strip_prefix(&number.to_string())?;
    rest.starts_with(['.', ')', ':']).then(|| label(&rest[1..], labels))?
}

fn as_text(value: &Loose) -> String {
    match value {
        Loose::Null => String::new(),
        Loose::Text(text) => text.clone(),
        Loose::Bool(value) => value.to_string(),
        Loose::Number(number) => number.to_string(),
        Loose::List(items) => items.iter().map(as_text).collect::<Vec<_>>().join("\n"),
        Loose::Object(members) => {
            let lines = members.iter().map(|(key, value)| format!("{key}: {}", as_text(value)));
            lines.collect::<Vec<_>>().join("\n")
        }
    }
}

/// Returns how certain the model says it is; `None` if it says something else.
fn certainty_of(value: &Loose) -> Option<Certainty> {
    let Loose::Text(text) = value else { return None };
    Some(match plain(text).as_str() {
        "certain" | "sure" => Certainty::Certain,
        "likely" => Certainty::Likely,
        "unsure" | "uncertain" | "unlikely" => Certainty::Unsure,
        "none" | "noneofthese" => Certainty::None,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels() -> Vec<String> {
        ["A", "B", "C", "D"].map(str::to_owned).into()
    }

    fn groups(text: &str) -> Result<(Groups, usize), AnswerError> {
        read(text, &labels(), false).map(|reading| (reading.groups, reading.left_out))
    }

    const RIGHT: &str =
        r#"{"reasoning": "a sign", "ranking": ["C", "A", "D", "B"], "certainty": "likely"}"#;

    #[test]
    fn an_answer_is_found_in_any_of_its_formats() {
        let quoted = r#"The sign reads {"reasoning": "…", "ranking": ["B"]}."#;
        for text in [
            RIGHT.to_owned(),
            format!("Here it is:\n```json\n{RIGHT}\n```\nDone."),
            format!("I think {RIGHT} is right"),
            format!("Not {{this}}, but {RIGHT}, as {{said}}"),
            format!("[{RIGHT}]"),
            format!("{{\"answer\": {RIGHT}}}"),
            format!("{{\"name\": \"ranking\", \"arguments\": {RIGHT}}}"),
            serde_json::to_string(RIGHT).unwrap(),
            serde_json::json!({"name": "ranking", "arguments": RIGHT}).to_string(),
            format!("{quoted} {RIGHT}"),
            format!("{RIGHT} {quoted}"),
            format!("{} {RIGHT}", RIGHT.replace("\"C\", \"A\"", "\"A\", \"C\"")),
            RIGHT
                .replace("\"reasoning\"", "\"Reasoning\"")
                .replace("\"ranking\"", "\"Final Ranking\""),
            RIGHT.replace("\"a sign\"", "\"the sign \"BAR\" fits,\nand \"the\" door\""),
            RIGHT.replace("]", ",]").replace('}', ",}"),
            RIGHT.replace('}', ""),
            RIGHT.replace('"', "'"),
            "a sign\nRANKING: C, A, D, B".to_owned(),
            "a sign\n**Ranking:** C > A > D > B.".to_owned(),
            "a sign\n\n1. C\n2. Candidate A\n3. **D**: perhaps\n4. B".to_owned(),
            "C > A > D > B".to_owned(),
            "[\"C\", \"A\", \"D\", \"B\"]".to_owned(),
            "{\"1\": \"C\", \"2\": \"A\", \"3\": \"D\", \"4\": \"B\"}".to_owned(),
        ] {
            let wanted = (vec![vec![2], vec![0], vec![3], vec![1]], 0);
            assert_eq!(groups(&text), Ok(wanted), "{text}");
        }
    }

    #[test]
    fn reasoning_may_be_null_or_a_list() {
        for (reasoning, wanted) in
            [("null", ""), (r#"["one", "two"]"#, "one\ntwo"), (r#"{"A": "no"}"#, "A: no")]
        {
            let text = RIGHT.replace("\"a sign\"", reasoning);
            let reading = read(&text, &labels(), false).unwrap();
            assert_eq!((reading.reasoning.as_str(), reading.left_out), (wanted, 0), "{text}");
            assert_eq!(reading.certainty, Some(Certainty::Likely));
        }
    }

    #[test]
    fn an_answer_to_some_of_the_labels_says_how_many_it_leaves_out() {
        let ranking = |list: &str| groups(&format!(r#"{{"reasoning": "", "ranking": {list}}}"#));
        assert_eq!(ranking(r#"["D", "D", "X", "", "B", "d"]"#), Ok((vec![vec![3], vec![1]], 2)));
        assert_eq!(ranking(r#"["X", "Y"]"#), Err(AnswerError::NoLabel));
        assert_eq!(ranking("[]"), Err(AnswerError::NoLabel));
        assert_eq!(ranking("[1, 3, 2, 0]"), Err(AnswerError::Ambiguous));
        assert_eq!(ranking("\"A\""), Ok((vec![vec![0]], 3)));
    }

    #[test]
    fn two_answers_that_differ_are_ambiguous_unless_both_are_objects() {
        let text = format!("{RIGHT}\nRANKING: A > B > C > D");
        assert_eq!(groups(&text), Err(AnswerError::Ambiguous));
        let cut = format!("{RIGHT} is a first draft, but on reflection {{\"reasoning\": \"no");
        assert_eq!(read(&cut, &labels(), true), Err(AnswerError::Ambiguous));
        assert!(read(RIGHT, &labels(), true).is_ok());
    }

    #[test]
    fn a_text_without_a_ranking_is_an_error() {
        for text in [
            "",
            "I cannot rank these.",
            "{}",
            "}{",
            "A, B",
            "RANKING: A\nand so on",
            r#"{"reasoning": "the ranking is ["#,
            r#"{"type": "object", "properties": {"ranking": {"type": "array"}}}"#,
            &"{".repeat(100_000),
        ] {
            assert_eq!(groups(text), Err(AnswerError::NoRanking), "{text:.40}");
        }
    }
}
