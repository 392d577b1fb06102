//! Separates what a model thought from what it answered.
//!
//! Servers put thinking into a field of its own, or leave it in the text between tags, of which the model may
//! write only one. Thinking quotes templates and drafts, and so must never be read as an answer.

/// A model's text, taken apart.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Spoken {
    /// The answer; empty if there was only thinking.
    pub answer: String,
    /// The thinking.
    pub thinking: String,
}

/// Names of tags `<name>…</name>` around thinking.
const NAMES: [&str; 13] = [
    "think",
    "thinking",
    "thought",
    "thoughts",
    "reasoning",
    "reflection",
    "analysis",
    "scratchpad",
    "inner_monologue",
    "internal_thoughts",
    "antthinking",
    "seed:think",
    "mm:think",
];

/// Other marks around thinking, in lower case.
const MARKS: [(&str, &str); 8] = [
    ("[think]", "[/think]"),
    ("◁think▷", "◁/think▷"),
    ("<|begin_of_thought|>", "<|end_of_thought|>"),
    ("<|start_thinking|>", "<|end_thinking|>"),
    ("<|think|>", "<|/think|>"),
    ("<unused94>", "<unused95>"),
    ("<|channel>thought", "<channel|>"),
    ("```thinking", "\n```"),
];

/// Marks that some servers leave around the answer.
const LEFTOVERS: [&str; 14] = [
    "<|begin_of_box|>",
    "<|end_of_box|>",
    "<|im_end|>",
    "<|eot_id|>",
    "<|eom_id|>",
    "<|return|>",
    "<|end|>",
    "<|endoftext|>",
    "<|end_of_text|>",
    "<|end_of_turn|>",
    "<end_of_turn>",
    "<end_of_utterance>",
    "<|START_RESPONSE|>",
    "<|END_RESPONSE|>",
];

/// Tags around an answer.
const WRAPPERS: [&str; 5] = ["answer", "response", "output", "final", "final_answer"];

/// The longest tag, attributes included, in bytes.
const LONGEST_TAG: usize = 120;

/// Takes a text apart. Thinking whose beginning is not marked begins with the text; thinking whose end is not
/// marked ends with it.
pub fn split(text: &str) -> Spoken {
    let mut spoken = match channels(text).or_else(|| announced(text)) {
        Some(spoken) => spoken,
        None => tagged(text),
    };
    spoken.answer = unwrapped(&spoken.answer);
    spoken.thinking = spoken.thinking.trim().to_owned();
    spoken
}

/// The channels of the harmony format, of which only the last `final` is the answer.
fn channels(text: &str) -> Option<Spoken> {
    const CHANNEL: &str = "<|channel|>";
    const MESSAGE: &str = "<|message|>";
    text.contains(CHANNEL).then_some(())?;
    let lower = text.to_ascii_lowercase();
    let all = || Spoken { answer: String::new(), thinking: text.to_owned() };
    let Some(at) = lower.rfind("<|channel|>final") else { return Some(all()) };
    let Some(begins) = text[at..].find(MESSAGE).map(|found| at + found + MESSAGE.len()) else {
        return Some(all());
    };
    Some(Spoken { answer: text[begins..].to_owned(), thinking: text[..at].to_owned() })
}

/// Thinking and answer, announced in words.
fn announced(text: &str) -> Option<Spoken> {
    let lower = text.to_ascii_lowercase();
    // The harmony format whose marks were dropped.
    if lower.starts_with("analysis")
        && let Some(at) = text.rfind("assistantfinal")
    {
        let answer = text[at + "assistantfinal".len()..].to_owned();
        return Some(Spoken { answer, thinking: text[..at].to_owned() });
    }
    lower.trim_start().starts_with("here is my thought process").then_some(())?;
    let answer = "here is my response:";
    Some(match lower.find(answer) {
        Some(at) => {
            Spoken { answer: text[at + answer.len()..].to_owned(), thinking: text[..at].to_owned() }
        }
        None => Spoken { answer: String::new(), thinking: text.to_owned() },
    })
}

/// A mark in a text.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Mark {
    /// The tag's name, or the opening mark.
    kind: &'static str,
    opens: bool,
    length: usize,
}

fn tagged(text: &str) -> Spoken {
    // Has the same byte offsets as the text.
    let lower = text.to_ascii_lowercase();
    let mut spoken = Spoken::default();
    let mut at = 0;
    while let Some((start, mark)) = next_mark(&lower, at, None) {
        if !mark.opens {
            spoken.thinking.push_str(&spoken.answer);
            spoken.answer.clear();
            spoken.thinking.push_str(&text[at..start]);
            at = start + mark.length;
            continue;
        }
        spoken.answer.push_str(&text[at..start]);
        let inside = start + mark.length;
        let (end, after) = closing(&lower, inside, mark.kind);
        spoken.thinking.push_str(&text[inside..end]);
        spoken.thinking.push('\n');
        at = after;
    }
    spoken.answer.push_str(&text[at..]);
    spoken
}

/// Returns where thinking of this kind ends, and where its closing mark ends.
fn closing(lower: &str, from: usize, kind: &'static str) -> (usize, usize) {
    let (mut at, mut depth) = (from, 1_usize);
    while let Some((start, mark)) = next_mark(lower, at, Some(kind)) {
        depth = if mark.opens { depth + 1 } else { depth - 1 };
        at = start + mark.length;
        if depth == 0 {
            return (start, at);
        }
    }
    (lower.len(), lower.len())
}

/// Finds the next mark, of any kind or of one.
fn next_mark(lower: &str, from: usize, kind: Option<&str>) -> Option<(usize, Mark)> {
    let begins = |c: char| matches!(c, '<' | '[' | '◁' | '`' | '\n');
    lower[from..].match_indices(begins).find_map(|(at, _)| {
        let start = from + at;
        let mark = mark_at(&lower[start..])?;
        // A code fence closes only what a fence opened.
        let fits = kind.map_or(mark.opens || mark.kind != "```thinking", |kind| kind == mark.kind);
        fits.then_some((start, mark))
    })
}

fn mark_at(lower: &str) -> Option<Mark> {
    let plain = MARKS.iter().find_map(|&(open, close)| {
        let (opens, length) = match (lower.starts_with(open), lower.starts_with(close)) {
            (true, _) => (true, open.len()),
            (false, true) => (false, close.len()),
            (false, false) => return None,
        };
        Some(Mark { kind: open, opens, length })
    });
    plain.or_else(|| {
        let inside = lower.strip_prefix('<')?;
        let (opens, inside) = match inside.strip_prefix('/') {
            Some(rest) => (false, rest),
            None => (true, inside),
        };
        let name = |name: &&'static str| {
            let rest = inside.strip_prefix(*name);
            rest.is_some_and(|rest| rest.starts_with(['>', ' ', '\n']))
        };
        let kind = NAMES.into_iter().find(name)?;
        let end = lower.find('>').filter(|end| *end <= LONGEST_TAG)?;
        Some(Mark { kind, opens, length: end + 1 })
    })
}

/// Removes what servers and models put around an answer.
fn unwrapped(answer: &str) -> String {
    let mut answer = answer.to_owned();
    for leftover in LEFTOVERS {
        if answer.contains(leftover) {
            answer = answer.replace(leftover, "");
        }
    }
    let trimmed = answer.trim();
    let lower = trimmed.to_ascii_lowercase();
    for name in WRAPPERS {
        let (open, close) = (format!("<{name}>"), format!("</{name}>"));
        if lower.starts_with(&open) {
            let end = lower.rfind(&close).unwrap_or(lower.len()).max(open.len());
            return trimmed[open.len()..end].trim().to_owned();
        }
    }
    trimmed.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinking_is_no_part_of_the_answer() {
        for text in [
            "<think>draft</think>answer",
            "<THINK time=\"3\">draft</THINK>\n\nanswer",
            "draft</think>answer",
            "a<think>b</think>c</think>answer",
            "<thinking>draft <thinking>deeper</thinking> more</thinking> answer",
            "[THINK]draft[/THINK]answer",
            "◁think▷draft◁/think▷answer",
            "<|START_THINKING|>draft<|END_THINKING|><|START_RESPONSE|>answer<|END_RESPONSE|>",
            "<|channel|>analysis<|message|>draft<|end|><|start|>assistant<|channel|>final<|message|>answer<|return|>",
            "<|channel|>analysis<|message|>draft<|channel|>final <|constrain|>json<|message|>answer",
            "analysisWe draft.assistantfinalanswer",
            "<unused94>thought\ndraft<unused95>answer",
            "Here is my thought process: draft Here is my response: answer",
            "<think>draft</think><answer>answer</answer>",
            "<seed:think>draft</seed:think>answer<|im_end|>",
        ] {
            assert_eq!(split(text).answer, "answer", "{text}");
        }
    }

    #[test]
    fn thinking_without_an_end_leaves_no_answer() {
        for text in ["<think>draft answer", "<|channel|>analysis<|message|>draft", "[THINK]draft"] {
            let spoken = split(text);
            assert!(spoken.answer.is_empty() && spoken.thinking.contains("draft"), "{text}");
        }
    }

    #[test]
    fn a_text_without_thinking_is_left_alone() {
        for text in ["a < b > c", "the sign says [A], <b>", "```json\n{}\n```", "é◁", ""] {
            assert_eq!(split(text), Spoken { answer: text.into(), thinking: String::new() });
        }
    }
}
