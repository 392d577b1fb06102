//! Reads an order of labels from what a model put under `ranking`.

use super::loose_json::Loose;

/// Labels, best first, by their number. Those of one group are tied.
pub type Groups = Vec<Vec<usize>>;

/// What a value says about the order of the labels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Order {
    /// These labels in this order; none of them twice.
    Labels(Groups),
    /// It can be read in more than one way.
    Ambiguous,
    /// It names no label.
    Nothing,
}

/// Keys of the label in an object that stands for a candidate.
const LABEL_KEYS: [&str; 11] = [
    "label",
    "candidate",
    "candidatelabel",
    "id",
    "name",
    "image",
    "imagelabel",
    "option",
    "place",
    "letter",
    "candidateid",
];

const RANK_KEYS: [&str; 3] = ["rank", "position", "ranking"];
const SCORE_KEYS: [&str; 6] =
    ["score", "confidence", "likelihood", "probability", "similarity", "certainty"];

/// Words that models put before a label.
const NOUNS: [&str; 12] = [
    "candidate",
    "image",
    "label",
    "option",
    "photo",
    "photograph",
    "picture",
    "location",
    "place",
    "notes",
    "pair",
    "choice",
];

const ORDINALS: [&str; 10] =
    ["first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth"];

/// Reads the value of `ranking`.
pub fn order(value: &Loose, labels: &[String]) -> Order {
    match value {
        Loose::Text(text) => in_text(text, labels, false),
        Loose::List(items) => in_list(items, labels),
        Loose::Object(members) => in_object(members, labels),
        Loose::Null | Loose::Bool(_) | Loose::Number(_) => Order::Nothing,
    }
}

/// Reads an order from a line of text. If it is `strict`, all of the line must be labels.
pub fn in_text(text: &str, labels: &[String], strict: bool) -> Order {
    let text = text.replace("&gt;", ">");
    let better = ['>', '≻', '→', '›', '»'];
    let tied = [',', ';', '=', '≈', '~', '/', '&'];
    if !text.contains(better)
        && !text.contains([',', ';', '\n', '|'])
        && let Some(index) = label(&text, labels)
    {
        return found(vec![vec![index]]);
    }
    let parts: Vec<Vec<&str>> = if text.contains(better) {
        text.split(better).map(|part| part.split(tied).collect()).collect()
    } else if text.contains([',', ';', '\n', '|']) {
        text.split([',', ';', '\n', '|']).map(|part| vec![part]).collect()
    } else {
        text.split_whitespace().map(|part| vec![part]).collect()
    };
    let mut groups = Vec::new();
    for part in parts {
        let known: Vec<usize> = part.iter().filter_map(|part| label(part, labels)).collect();
        if strict && known.len() < part.len() {
            return Order::Nothing;
        }
        groups.push(known);
    }
    match found(groups) {
        Order::Nothing if !strict => together(&text, labels),
        order => order,
    }
}

/// Reads `CADB`.
fn together(text: &str, labels: &[String]) -> Order {
    let letters: Vec<String> = text.trim().chars().map(String::from).collect();
    let known: Vec<Vec<usize>> = letters
        .iter()
        .filter_map(|letter| label(letter, labels))
        .map(|index| vec![index])
        .collect();
    match letters.len() == labels.len() && known.len() == labels.len() {
        true => found(known),
        false => Order::Nothing,
    }
}

fn in_list(items: &[Loose], labels: &[String]) -> Order {
    if let [only @ (Loose::List(_) | Loose::Text(_))] = items {
        return order(only, labels);
    }
    let numbers: Vec<f64> = items.iter().filter_map(as_number).collect();
    if !items.is_empty() && numbers.len() == items.len() {
        return in_numbers(&numbers, labels.len());
    }
    let objects: Vec<Member> = items.iter().filter_map(|item| Member::of(item, labels)).collect();
    if !items.is_empty() && objects.len() == items.len() {
        return in_members(&objects, labels.len());
    }
    let groups = items.iter().map(|item| match item {
        Loose::Text(text) => Vec::from_iter(label(text, labels)),
        Loose::List(tied) => tied
            .iter()
            .filter_map(|item| match item {
                Loose::Text(text) => label(text, labels),
                item => Member::of(item, labels).map(|member| member.label),
            })
            .collect(),
        item => Vec::from_iter(Member::of(item, labels).map(|member| member.label)),
    });
    found(groups.collect())
}

/// Numbers alone may be the numbers of candidates or the ranks of A, B, … They say something only if both say
/// the same.
fn in_numbers(numbers: &[f64], labels: usize) -> Order {
    let Some(ranks) = whole(numbers) else { return Order::Ambiguous };
    let is_permutation = ranks.len() == labels && (1..=labels).all(|rank| ranks.contains(&rank));
    let inverse = |rank: usize| ranks.iter().position(|&other| other == rank).map(|at| at + 1);
    match is_permutation && ranks.iter().enumerate().all(|(at, &n)| inverse(at + 1) == Some(n)) {
        true => found(ranks.iter().map(|&number| vec![number - 1]).collect()),
        false => Order::Ambiguous,
    }
}

/// A candidate with its rank or score.
struct Member {
    label: usize,
    rank: Option<f64>,
    score: Option<f64>,
}

impl Member {
    fn of(item: &Loose, labels: &[String]) -> Option<Self> {
        let Loose::Object(members) = item else { return None };
        if let [(key, value)] = members.as_slice()
            && let Some(label) = label(key, labels)
        {
            return Some(Self { label, rank: None, score: as_number(value) });
        }
        let value = |keys: &[&str]| {
            members.iter().find(|(key, _)| keys.contains(&plain(key).as_str())).map(|(_, v)| v)
        };
        let named = match value(&LABEL_KEYS)? {
            Loose::Text(text) => label(text, labels)?,
            _ => return None,
        };
        let rank = value(&RANK_KEYS).and_then(as_number);
        let score = value(&SCORE_KEYS).and_then(as_number);
        Some(Self { label: named, rank, score })
    }
}

fn in_members(members: &[Member], labels: usize) -> Order {
    let ranks: Vec<f64> = members.iter().filter_map(|member| member.rank).collect();
    if ranks.len() == members.len() {
        let pairs = members.iter().map(|member| member.label).zip(ranks).collect();
        return by_rank(pairs, labels);
    }
    let scores: Vec<f64> = members.iter().filter_map(|member| member.score).collect();
    match scores.len() < members.len() || scores.is_sorted_by(|one, other| one >= other) {
        true => found(members.iter().map(|member| vec![member.label]).collect()),
        false => Order::Ambiguous,
    }
}

fn in_object(members: &[(String, Loose)], labels: &[String]) -> Order {
    // {"A": 2, "B": 1}
    let by_label: Vec<(usize, f64)> = members
        .iter()
        .filter_map(|(key, value)| Some((label(key, labels)?, as_number(value)?)))
        .collect();
    if !members.is_empty() && by_label.len() == members.len() {
        return by_rank(by_label, labels.len());
    }
    // {"1": "B", "2": "A"}
    let mut by_number: Vec<(usize, Vec<usize>)> = members
        .iter()
        .filter_map(|(key, value)| {
            let group = match value {
                Loose::Text(text) => vec![label(text, labels)?],
                Loose::List(_) => match order(value, labels) {
                    Order::Labels(groups) => groups.concat(),
                    _ => return None,
                },
                item => vec![Member::of(item, labels)?.label],
            };
            Some((ordinal(key)?, group))
        })
        .collect();
    if by_number.is_empty() || by_number.len() < members.len() {
        return Order::Nothing;
    }
    by_number.sort_by_key(|(number, _)| *number);
    found(by_number.into_iter().map(|(_, group)| group).collect())
}

/// Orders labels by ranks, if the numbers cannot be anything else: 1 for the first and then one after the other,
/// with ties.
fn by_rank(pairs: Vec<(usize, f64)>, labels: usize) -> Order {
    let numbers: Vec<f64> = pairs.iter().map(|(_, rank)| *rank).collect();
    let Some(mut ranks) = whole(&numbers) else { return Order::Ambiguous };
    let mut ranked: Vec<(usize, usize)> =
        ranks.iter().copied().zip(pairs.iter().map(|(label, _)| *label)).collect();
    ranks.sort_unstable();
    let dense = ranks.windows(2).all(|pair| pair[1] - pair[0] <= 1);
    let skipping = ranks.iter().enumerate().all(|(at, rank)| {
        let before = ranks.iter().filter(|other| *other < rank).count();
        *rank == before + 1 && at < labels
    });
    if ranks.first() != Some(&1) || !(dense || skipping) {
        return Order::Ambiguous;
    }
    ranked.sort_by_key(|(rank, _)| *rank);
    let groups = ranked.chunk_by(|one, other| one.0 == other.0);
    found(groups.map(|group| group.iter().map(|(_, label)| *label).collect()).collect())
}

/// Drops repeated labels and empty groups.
fn found(groups: Groups) -> Order {
    let mut seen = Vec::new();
    let mut kept = Vec::new();
    for group in groups {
        let mut fresh: Vec<usize> =
            group.into_iter().filter(|label| !seen.contains(label)).collect();
        fresh.sort_unstable();
        fresh.dedup();
        seen.extend(&fresh);
        if !fresh.is_empty() {
            kept.push(fresh);
        }
    }
    if kept.is_empty() { Order::Nothing } else { Order::Labels(kept) }
}

/// Returns the number of the label that a text stands for: `A`, `Candidate A`, `[A]`, `1. A`, `A: because …`
pub fn label(text: &str, labels: &[String]) -> Option<usize> {
    let trim =
        |text: &str| -> String { text.trim_matches(|c: char| !c.is_alphanumeric()).to_owned() };
    let mut rest = trim(text);
    if let Some(known) = exact(&rest, labels) {
        return Some(known);
    }
    // "1. A", "2) A"
    let after_number = rest.trim_start_matches(|c: char| c.is_ascii_digit());
    if after_number.len() < rest.len() && after_number.starts_with(['.', ')', ':', ' ']) {
        rest = trim(after_number);
    }
    for noun in NOUNS {
        if rest.get(..noun.len()).is_some_and(|start| start.eq_ignore_ascii_case(noun))
            && rest[noun.len()..].starts_with([' ', '_', '-', '#', ':', '*', '\n', '"', '('])
        {
            rest = trim(&rest[noun.len()..]);
            break;
        }
    }
    exact(&rest, labels).or_else(|| {
        let ends = rest.find(|c: char| !c.is_alphanumeric())?;
        let after = rest[ends..].trim_start_matches(['*', '"', '\'', ']', '`']);
        let explains = [":", "(", " (", " - ", " – ", " — ", "—", "–", ". "];
        explains.iter().any(|sign| after.starts_with(sign)).then(|| exact(&rest[..ends], labels))?
    })
}

fn exact(text: &str, labels: &[String]) -> Option<usize> {
    labels.iter().position(|known| known.eq_ignore_ascii_case(text))
}

/// Returns the rank that a key names: `1`, `1st`, `rank_1`, `first`.
fn ordinal(key: &str) -> Option<usize> {
    let key = plain(key);
    let digits: String = key.chars().filter(char::is_ascii_digit).collect();
    match digits.parse() {
        Ok(number) => Some(number),
        Err(_) => ORDINALS.iter().position(|word| key.contains(word)).map(|index| index + 1),
    }
}

/// Returns a key in lower case without anything but letters and digits.
pub fn plain(key: &str) -> String {
    key.chars().filter(|c| c.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

fn as_number(value: &Loose) -> Option<f64> {
    match value {
        Loose::Number(number) => Some(*number),
        Loose::Text(text) => text.trim().parse().ok().filter(|number: &f64| number.is_finite()),
        _ => None,
    }
}

fn whole(numbers: &[f64]) -> Option<Vec<usize>> {
    let small = |number: &f64| number.fract() == 0.0 && (1.0..=1000.0).contains(number);
    numbers.iter().all(small).then(|| numbers.iter().map(|number| *number as usize).collect())
}

#[cfg(test)]
mod tests {
    use super::super::loose_json::value_at;
    use super::*;

    fn read(json: &str) -> Order {
        let labels: Vec<String> = ["A", "B", "C", "D"].map(str::to_owned).into();
        order(&value_at(json).unwrap(), &labels)
    }

    #[test]
    fn an_order_is_read_in_any_shape_that_has_one_meaning() {
        let wanted = Order::Labels(vec![vec![2], vec![0], vec![3], vec![1]]);
        for json in [
            r#"["C", "A", "D", "B"]"#,
            r#"["candidate c", "[A]", "**D**", "Candidate_B."]"#,
            r#"["1. C", "2. A", "3. D", "4. B"]"#,
            r#"["C: the sign fits", "A (the door)", "D - maybe", "B — no"]"#,
            r#"[["C"], ["A"], ["D"], ["B"]]"#,
            r#"[["C", "A", "D", "B"]]"#,
            r#"["C > A > D > B"]"#,
            r#""C > A > D > B""#,
            r#""C, A, D, B""#,
            r#""1. C, 2. A, 3. D, 4. B""#,
            r#""C A D B""#,
            r#""CADB""#,
            r#"[{"label": "C"}, {"label": "A"}, {"label": "D"}, {"label": "B"}]"#,
            r#"[{"candidate": "B", "rank": 4}, {"candidate": "A", "rank": 2}, {"candidate": "C", "rank": 1}, {"candidate": "D", "rank": 3}]"#,
            r#"[{"C": 0.9}, {"A": 0.5}, {"D": 0.2}, {"B": 0.1}]"#,
            r#"{"A": 2, "B": 4, "C": 1, "D": 3}"#,
            r#"{"1": "C", "2": "A", "3": "D", "4": "B"}"#,
            r#"{"2nd": "A", "1st": "C", "4th": "B", "3rd": "D"}"#,
            r#"{"first": "C", "second": "A", "third": "D", "fourth": "B"}"#,
            r#"["C", "C", "A", "Z", "D", "", "B", "A"]"#,
        ] {
            assert_eq!(read(json), wanted, "{json}");
        }
    }

    #[test]
    fn ties_are_kept_as_ties() {
        let tied = Order::Labels(vec![vec![2], vec![0, 3], vec![1]]);
        for json in [
            r#"["C", ["D", "A"], "B"]"#,
            r#""C > A = D > B""#,
            r#""C > D, A > B""#,
            r#"{"C": 1, "D": 2, "A": 2, "B": 3}"#,
            r#"{"C": 1, "D": 2, "A": 2, "B": 4}"#,
        ] {
            assert_eq!(read(json), tied, "{json}");
        }
    }

    #[test]
    fn what_can_be_read_in_two_ways_is_ambiguous() {
        for json in [
            "[3, 1, 4, 2]",
            "[0, 1, 2, 3]",
            r#"{"A": 0.9, "B": 0.4}"#,
            r#"{"A": 5, "B": 9, "C": 1, "D": 2}"#,
            r#"[{"label": "A", "score": 0.1}, {"label": "B", "score": 0.9}]"#,
        ] {
            assert_eq!(read(json), Order::Ambiguous, "{json}");
        }
        // Both readings of these numbers say the same.
        assert_eq!(read("[2, 1, 3, 4]"), Order::Labels(vec![vec![1], vec![0], vec![2], vec![3]]));
        for json in ["[]", r#"["X", "the most likely label"]"#, r#""A shop, by a wall""#] {
            assert_eq!(read(json), Order::Nothing, "{json}");
        }
    }
}
