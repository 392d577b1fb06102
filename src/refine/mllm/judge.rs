//! Decides whether an answer is a description. What is none is neither cached nor shown to the reasoning model.

use std::collections::HashSet;

use super::client::Answer;
use super::prompts::{Switches, clean, parts};

/// The longest refusal, in characters.
const LONGEST_REFUSAL: usize = 800;

/// Where a refusal says so, in characters from the beginning.
const REFUSAL_BEGINS: usize = 240;

/// The shortest description, in words.
const LEAST_WORDS: usize = 8;

/// The least that is written besides the names of the parts, in letters and digits.
const LEAST_CONTENT: usize = 8;

/// A text of this many words that has only [`FEW_WORDS`] different ones is a loop of the model.
const MANY_WORDS: usize = 40;
const FEW_WORDS: usize = 8;

/// The shortest description in another script, in characters.
const LONG: usize = 100;

/// Returns the description in an answer, or why there is none.
pub fn description(
    answer: &Answer,
    switches: Switches,
    max_chars: usize,
) -> Result<String, String> {
    if let Some(flaw) = &answer.flaw {
        return Err(flaw.to_string());
    }
    let text = clean(&answer.text, max_chars);
    if text.is_empty() {
        return Err(match answer.thinking.trim().is_empty() {
            true => "the model said nothing".to_owned(),
            false => "the model only thought, and said nothing".to_owned(),
        });
    }
    let headings = parts(switches).into_iter().filter(|part| has_heading(&text, part)).count();
    if headings < 2 && refuses(&text) {
        let begins: String = text.chars().take(120).collect();
        return Err(format!("the model refused: {begins}"));
    }
    if repeats_itself(&text) {
        return Err("the model repeats a few words over and over".to_owned());
    }
    if headings >= 2 && !has_content(&text, switches) {
        return Err("the parts that were asked for are empty".to_owned());
    }
    if headings < 2 && !speaks_of_both(&text) {
        let names = parts(switches).join(", ");
        return Err(format!("the answer has none of the parts that were asked for ({names})"));
    }
    Ok(text)
}

/// Whether a long text has hardly any different words.
fn repeats_itself(text: &str) -> bool {
    let words: Vec<&str> = text.split_whitespace().collect();
    let different: HashSet<&str> = words.iter().copied().collect();
    words.len() >= MANY_WORDS && different.len() <= FEW_WORDS
}

/// Whether something is written besides the names of the parts.
fn has_content(text: &str, switches: Switches) -> bool {
    let mut rest = text.to_lowercase();
    for part in parts(switches) {
        rest = rest.replace(&part.to_lowercase(), "");
    }
    rest.chars().filter(|c| c.is_alphanumeric()).count() >= LEAST_CONTENT
}

/// Whether a line begins with the name of a part, whatever formats it.
fn has_heading(text: &str, part: &str) -> bool {
    text.lines().any(|line| {
        let line = line.trim_start_matches(|c: char| !c.is_alphabetic());
        line.get(..part.len()).is_some_and(|start| start.eq_ignore_ascii_case(part))
    })
}

/// Whether a text says that the model cannot or will not describe the pictures.
pub(super) fn refuses(text: &str) -> bool {
    let begins: String = text.chars().take(REFUSAL_BEGINS).collect();
    let begins = begins.to_lowercase().replace(['’', '‘', '`'], "'");
    text.chars().count() <= LONGEST_REFUSAL && REFUSALS.iter().any(|words| begins.contains(words))
}

/// Whether a text compares two pictures: it is more than a sentence or so, and speaks of what the prompt asks for.
fn speaks_of_both(text: &str) -> bool {
    let lower = text.to_lowercase();
    let spoken = SUBJECTS.iter().filter(|words| words.iter().any(|word| lower.contains(word)));
    let subjects = spoken.count();
    let length = text.chars().count();
    let foreign = text.chars().filter(|c| !c.is_ascii()).count() > length / 2;
    let long = length >= LONG;
    (subjects >= 1 && text.split_whitespace().count() >= LEAST_WORDS) || (long && foreign)
}

const SUBJECTS: [&[&str]; 7] = [
    &["door", "wall", "window", "sign", "building", "shop", "street", "facade", "lamp", "brick"],
    &["frame", "first image", "first picture", "first photo", "query", "image 1", "picture 1"],
    &["candidate", "second image", "second picture", "second photo", "image 2", "picture 2"],
    &["object", "left to right"],
    &["match", "counterpart", "both", "same", "common", "corresponds"],
    &["differ", "dissimilar", "contrast", "missing", "whereas", "unlike", "absent"],
    &["similarit", "agree", "alike", "comparison", "compared", "resembl"],
];

const REFUSALS: &[&str] = &[
    "i can't help",
    "i cannot help",
    "i can not help",
    "i can't assist",
    "i cannot assist",
    "i can't see",
    "i cannot see",
    "i can't view",
    "i cannot view",
    "i can't process",
    "i cannot process",
    "i can't analyze",
    "i cannot analyze",
    "i can't compare",
    "i cannot compare",
    "i can't provide",
    "i cannot provide",
    "i can't fulfill",
    "i cannot fulfill",
    "i can't comply",
    "i cannot comply",
    "i am unable",
    "i'm unable",
    "i am not able",
    "i'm not able",
    "i won't",
    "i don't see any",
    "i do not see any",
    "i don't have access",
    "i do not have access",
    "i only see one",
    "i can only see one",
    "only one image",
    "only one picture",
    "no image",
    "no picture",
    "unable to view",
    "text-based",
    "as an ai",
    "please provide the",
    "please upload",
    "i'm sorry",
    "sorry, but",
    "my guidelines",
    "usage policy",
    "content policy",
    "usage policies",
    "error:",
    "failed to load",
    "could not load",
    "unable to load",
    "upload the",
    "could you upload",
    "could you provide",
    "can you provide",
    "not provided",
    "didn't receive",
    "did not receive",
    "not attached",
    "lo siento",
    "je suis désolé",
    "tut mir leid",
    "mi dispiace",
    "desculpe",
    "抱歉",
    "对不起",
    "申し訳",
    "죄송",
];

#[cfg(test)]
mod tests {
    use super::super::response::Flaw;
    use super::*;
    use std::time::Duration;

    const ALL: Switches = Switches { object_matching: true, constraints: true };

    fn judged(text: &str, flaw: Option<Flaw>) -> Result<String, String> {
        let answer = Answer {
            text: text.into(),
            thinking: String::new(),
            flaw,
            prompt_tokens: 1,
            completion_tokens: 1,
            estimated: false,
            took: Duration::ZERO,
        };
        description(&answer, ALL, 6000)
    }

    #[test]
    fn a_comparison_is_a_description() {
        for text in [
            "OBJECTS.\n- a sign \"BAR\"\nMATCHES.\n- sign: in the middle (sure)\nCOMPARISON. Brick.",
            "**Objects:** a door.\n\n### Comparison\nThe same door.",
            "The first image shows a shop with a green sign, the second one does, too. Both have a door.",
            "Similarities: the red door on the left. Dissimilarities: the lamp on the right.",
            "I'm unable to identify people, but here are my notes.\nOBJECTS. a door\nMATCHES. a door",
            &"画面里有一家银行，招牌上写着中国银行，候选图片里也有同样的招牌。".repeat(6),
        ] {
            assert!(judged(text, None).is_ok(), "{text}");
        }
    }

    #[test]
    fn anything_else_is_not() {
        for (text, why) in [
            ("", "said nothing"),
            (" \u{200b}\n", "said nothing"),
            ("I'm sorry, but I can’t help with that.", "refused"),
            (
                "I cannot see any images. Please upload the frame and the candidate first.",
                "refused",
            ),
            (
                "As an AI language model, I cannot view the frame or the candidate you mention here.",
                "refused",
            ),
            (
                "Error: failed to load image 1 and image 2: timeout while fetching them, retry later",
                "refused",
            ),
            (
                "Could you upload the second picture? The first picture shows a street with a door.",
                "refused",
            ),
            (
                "Sorry, but identifying buildings from photos is not something that I do, as a rule.",
                "refused",
            ),
            (
                "Lo siento, pero no puedo ayudar con la comparación del frame y el candidate.",
                "refused",
            ),
            (&"the door ".repeat(300), "over and over"),
            ("Objects:\n\nMatches:\n\nComparison:\n", "empty"),
            ("Yes.", "none of the parts"),
            ("Both look similar.", "none of the parts"),
            ("Sure! Here is what you asked for, dear user, I hope it helps.", "none of the parts"),
        ] {
            let error = judged(text, None).unwrap_err();
            assert!(error.contains(why), "{text}: {error}");
        }
        let whole = "OBJECTS. a door\nMATCHES. a door\nCOMPARISON. the same";
        for flaw in [Flaw::Cut, Flaw::Filtered, Flaw::Refused("no".into())] {
            assert_eq!(judged(whole, Some(flaw.clone())), Err(flaw.to_string()));
        }
    }
}
