//! What a server can do: found out by trying, kept, and revised when it refuses a request.
//!
//! The words of a refusal only decide what is tried first; whether a server can do something is decided by what it
//! answers without.

use jiff::Timestamp;
use whereabouts_core::ModelCapabilities;

use super::schema::AnswerFormat;
use super::settings::MaxTokensField;

/// What a server can do, as far as it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capabilities {
    /// Whether it takes two pictures in a request.
    pub two_pictures: Option<bool>,
    /// The strictest format of answers that it accepts.
    pub format: AnswerFormat,
    /// Whether it accepts a temperature.
    pub temperature: bool,
    /// The field that bounds the answer; `None` if it accepts neither.
    pub max_tokens_field: Option<MaxTokensField>,
    /// The longest answer that it lets a request ask for, in tokens, if that is less than the settings ask.
    pub answer_tokens: Option<u32>,
    /// Whether it takes a system message.
    pub system: bool,
    /// The length of its context, in tokens.
    pub context: Option<u64>,
    /// How many calls at once it says that it works on.
    pub slots: Option<usize>,
    /// When that was last found out.
    pub checked_at: Option<Timestamp>,
}

/// A request as it was sent.
#[derive(Debug, Clone, Copy)]
pub struct Sent {
    /// Whether it asked for a format of the answer.
    pub structured: bool,
    /// Its estimated size, in tokens.
    pub prompt_tokens: u64,
    /// The longest answer that it asked for, in tokens.
    pub answer_tokens: u32,
    /// Whether it was the short version of a request that has one.
    pub short: bool,
    /// Whether a short version could be sent.
    pub can_be_shorter: bool,
}

/// What to try after a refusal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NextTry {
    /// What to assume of the server.
    pub capabilities: Capabilities,
    /// Whether to send the short version.
    pub short: bool,
}

/// The shortest answer that is worth asking for, in tokens.
const LEAST_ANSWER: u64 = 256;

/// An answer that every context has room for and that is long enough, in tokens.
const SHORT_ANSWER: u32 = 1024;

/// Tokens that the estimate of a prompt may be short of.
const MARGIN: u64 = 64;

impl Capabilities {
    /// Assumes that a server can do everything.
    pub fn assumed(temperature: bool, field: MaxTokensField) -> Self {
        Self {
            two_pictures: None,
            format: AnswerFormat::BoundedSchema,
            temperature,
            max_tokens_field: Some(field),
            answer_tokens: None,
            system: true,
            context: None,
            slots: None,
            checked_at: None,
        }
    }

    /// Assumes that a server can do nothing but answer.
    pub(super) fn plainest(self) -> Self {
        Self {
            format: AnswerFormat::Text,
            temperature: false,
            max_tokens_field: None,
            answer_tokens: None,
            system: false,
            ..self
        }
    }

    /// Returns how many features a form of requests leaves out that this one has.
    pub fn left_out_by(&self, form: &Self) -> usize {
        let left_out = [
            self.format != form.format,
            self.temperature && !form.temperature,
            self.max_tokens_field.is_some() && form.max_tokens_field.is_none(),
            self.system && !form.system,
        ];
        left_out.into_iter().filter(|left_out| *left_out).count()
    }

    /// Assumes again that the server can do everything that a request may leave out.
    pub fn assume_again(&mut self, temperature: bool, field: MaxTokensField) {
        let Self { format, system, .. } = Self::assumed(temperature, field);
        (self.format, self.system) = (format, system);
        (self.temperature, self.max_tokens_field) = (temperature, Some(field));
    }

    /// Returns the longest answer to ask for, so that it fits into the context behind the prompt.
    pub fn fit(&self, wanted: u32, prompt_tokens: u64) -> u32 {
        let bound = self.answer_tokens.unwrap_or(u32::MAX).min(wanted);
        let Some(context) = self.context else { return bound };
        // Estimates of prompts are off by some percent.
        let left = context.saturating_sub(prompt_tokens + prompt_tokens / 10 + MARGIN);
        bound.min(u32::try_from(left.max(LEAST_ANSWER)).unwrap_or(u32::MAX))
    }

    /// Returns how long a prompt may be, in tokens, if that is known.
    pub fn prompt_room(&self) -> Option<u64> {
        let context = self.context?;
        let answer = (context / 4).clamp(LEAST_ANSWER, 1500);
        Some(context.saturating_sub(answer + MARGIN))
    }

    /// Returns what to try after this request was refused with these words; `None` if nothing is left to try.
    /// With `only_named`, nothing is tried that the words do not name.
    pub fn after(&self, words: &str, sent: Sent, only_named: bool) -> Option<NextTry> {
        let words = words.to_lowercase();
        let same = NextTry { capabilities: *self, short: sent.short };
        if let Some(next) = self.named(&words, sent) {
            return Some(next);
        }
        if only_named {
            return None;
        }
        let may_shorten = self.answer_tokens.is_none() && self.max_tokens_field.is_some();
        if may_shorten && sent.answer_tokens > SHORT_ANSWER {
            let capabilities = Self { answer_tokens: Some(SHORT_ANSWER), ..*self };
            return Some(NextTry { capabilities, ..same });
        }
        let plainest = self.plainest();
        if plainest != *self {
            return Some(NextTry { capabilities: plainest, ..same });
        }
        (sent.can_be_shorter && !sent.short).then_some(NextTry { short: true, ..same })
    }

    /// Leaves out what the words name.
    fn named(&self, words: &str, sent: Sent) -> Option<NextTry> {
        let says = |wanted: &[&str]| wanted.iter().any(|wanted| words.contains(wanted));
        let next = |capabilities| NextTry { capabilities, short: sent.short };
        if says(&CONTEXT) {
            return self.with_less(words, sent);
        }
        if sent.structured && says(&FORMAT) {
            return self.format.weaker().map(|format| next(Self { format, ..*self }));
        }
        if self.temperature && says(&["temperature"]) {
            return Some(next(Self { temperature: false, ..*self }));
        }
        if says(&["max_tokens", "max_completion_tokens", "max_new_tokens"]) {
            let is_bound =
                says(&["too large", "at most", "less than", "exceed", "maximum", "between"]);
            if is_bound && !says(&["not supported", "unsupported"]) {
                return self.with_less(words, sent);
            }
            let swapped = match self.max_tokens_field? {
                MaxTokensField::MaxCompletionTokens if !words.contains("instead of max_tokens") => {
                    Some(MaxTokensField::MaxTokens)
                }
                MaxTokensField::MaxTokens if says(&["max_completion_tokens"]) => {
                    Some(MaxTokensField::MaxCompletionTokens)
                }
                _ => None,
            };
            return Some(next(Self { max_tokens_field: swapped, ..*self }));
        }
        if self.system
            && says(&[
                "system role",
                "system message",
                "system prompt",
                "'system'",
                "roles must alternate",
                "role",
            ])
        {
            return Some(next(Self { system: false, ..*self }));
        }
        None
    }

    /// Asks for a shorter answer, or sends less.
    fn with_less(&self, words: &str, sent: Sent) -> Option<NextTry> {
        let named = context_in(words).filter(|context| self.context.is_none_or(|c| *context < c));
        if let Some(context) = named {
            let capabilities = Self { context: Some(context), ..*self };
            let fits = sent.prompt_tokens + sent.prompt_tokens / 10 + LEAST_ANSWER <= context;
            let shortened =
                capabilities.fit(sent.answer_tokens, sent.prompt_tokens) < sent.answer_tokens;
            if fits && shortened {
                return Some(NextTry { capabilities, short: sent.short });
            }
            if sent.can_be_shorter && !sent.short {
                return Some(NextTry { capabilities, short: true });
            }
        }
        let bound = bound_in(words).filter(|bound| *bound < sent.answer_tokens);
        let may_shorten = self.max_tokens_field.is_some();
        if may_shorten && (bound.is_some() || sent.answer_tokens > SHORT_ANSWER) {
            let shorter = || (sent.answer_tokens / 4).max(SHORT_ANSWER);
            let answer_tokens = Some(bound.unwrap_or_else(shorter));
            let capabilities = Self { answer_tokens, ..*self };
            return Some(NextTry { capabilities, short: sent.short });
        }
        (sent.can_be_shorter && !sent.short).then_some(NextTry { capabilities: *self, short: true })
    }

    /// Records that the long version of a request was refused and its short version of this size accepted.
    pub fn learn_context(&mut self, prompt_tokens: u64, answer_tokens: u32) {
        let bound = prompt_tokens + u64::from(answer_tokens.min(1500)) + MARGIN;
        self.context = Some(self.context.map_or(bound, |context| context.min(bound)));
    }

    /// Returns what the API shows.
    pub fn report(&self, at_once: usize) -> ModelCapabilities {
        ModelCapabilities {
            checked_at: self.checked_at,
            two_pictures: self.two_pictures,
            answer_format: self.format.as_str().to_owned(),
            temperature: self.temperature,
            max_tokens_field: self.max_tokens_field.map(|field| field.as_str().to_owned()),
            answer_tokens: self.answer_tokens,
            system_message: self.system,
            context_tokens: self.context,
            calls_at_once: at_once,
        }
    }
}

const CONTEXT: [&str; 9] = [
    "context length",
    "context size",
    "context window",
    "context_length",
    "exceed_context",
    "prompt is too long",
    "too many tokens",
    "input is too long",
    "inputs tokens",
];

const FORMAT: [&str; 11] = [
    "response_format",
    "response format",
    "json_schema",
    "json schema",
    "schema",
    "json_object",
    "structured",
    "grammar",
    "guided",
    "minitems",
    "json mode",
];

/// Returns the longest answer that a refusal names.
fn bound_in(words: &str) -> Option<u32> {
    let at = words.find("at most")?;
    let number = words[at..].split(|c: char| !c.is_ascii_digit()).find(|number| !number.is_empty());
    number?.parse().ok().filter(|bound| u64::from(*bound) >= LEAST_ANSWER)
}

/// Returns the length of the context that a refusal names: the first plausible number after the word.
fn context_in(words: &str) -> Option<u64> {
    let at = words.find("n_ctx").or_else(|| words.find("context"))?;
    let numbers = words[at..].split(|c: char| !c.is_ascii_digit());
    numbers
        .filter_map(|number| number.parse().ok())
        .find(|number| (256..=100_000_000).contains(number))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assumed() -> Capabilities {
        Capabilities::assumed(true, MaxTokensField::MaxCompletionTokens)
    }

    const SENT: Sent = Sent {
        structured: true,
        prompt_tokens: 6000,
        answer_tokens: 4096,
        short: false,
        can_be_shorter: true,
    };

    fn next(words: &str) -> NextTry {
        assumed().after(words, SENT, false).unwrap()
    }

    #[test]
    fn the_words_of_a_refusal_decide_what_is_left_out_first() {
        assert_eq!(next("minItems is not permitted").capabilities.format, AnswerFormat::Schema);
        assert_eq!(
            next("Unsupported parameter: 'response_format'").capabilities.format,
            AnswerFormat::Schema
        );
        assert!(!next("'temperature' does not support 0.2").capabilities.temperature);
        let field = next("Unrecognized request argument supplied: max_completion_tokens");
        assert_eq!(field.capabilities.max_tokens_field, Some(MaxTokensField::MaxTokens));
        let bound = next("max_tokens is too large: 4096. This model supports at most 2000 tokens");
        assert_eq!(bound.capabilities.answer_tokens, Some(2000));
        assert!(!next("System role not supported").capabilities.system);
        let shorter = next("something else").capabilities;
        assert_eq!(shorter.answer_tokens, Some(SHORT_ANSWER));
        let short = Sent { answer_tokens: SHORT_ANSWER, ..SENT };
        let next = shorter.after("something else", short, false).unwrap();
        assert_eq!(next.capabilities, shorter.plainest());
        assert_eq!(assumed().after("something else", SENT, true), None);
    }

    #[test]
    fn a_context_that_is_too_short_is_learned() {
        let words =
            "the request exceeds the available context size (4096 tokens), try increasing it";
        let long = next(words);
        assert_eq!((long.capabilities.context, long.short), (Some(4096), true));
        let words = "This model's maximum context length is 4096 tokens. However, you requested 5096 tokens";
        let fitting = Sent { prompt_tokens: 1000, ..SENT };
        let shorter = assumed().after(words, fitting, false).unwrap();
        assert!(!shorter.short);
        let fit = shorter.capabilities.fit(4096, 1000);
        assert!((2500..3000).contains(&fit), "{fit}");
    }

    #[test]
    fn the_tries_come_to_an_end() {
        for words in ["no", "schema", "context length", "max_tokens", "temperature and role"] {
            let (mut capabilities, mut sent, mut tries) = (assumed(), SENT, 0);
            while let Some(next) = capabilities.after(words, sent, false) {
                capabilities = next.capabilities;
                sent.short = next.short;
                sent.structured = capabilities.format != AnswerFormat::Text;
                sent.answer_tokens = capabilities.fit(4096, 6000);
                tries += 1;
                assert!(tries < 12, "{words}");
            }
        }
    }
}
