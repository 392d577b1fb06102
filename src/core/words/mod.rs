//! A place described in words, such as "opposite the pharmacy, with KAWA COFFEE on its left": which of the words may be
//! on signs ([`runs`]), and which images of a map they fit ([`Described`]).

mod common;
mod likelihood;
mod signs;

use std::ops::Range;

use super::text_search::{is_ideographic, plain};

pub use self::likelihood::{Described, Fit, WordsModel, sign_frequency, sign_ratio};
pub use self::signs::{Sign, SignIn, find_signs};

/// The most characters of a description.
pub const MAX_CHARS: usize = 500;

/// The most words of it that may be on signs. Later ones are ignored.
pub const MAX_WORDS: usize = 40;

/// A word that may be on a sign.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Word {
    /// The word as it was written.
    pub text: String,
    /// Whether it is a name by how it is written: in quotation marks, in capitals, or with a capital where there would be
    /// none otherwise. A sign with it exists, whether or not it is in the map.
    pub is_name: bool,
    /// Whether it is a word for a place, such as street, which is on a sign only together with others.
    pub is_common: bool,
}

/// Words in a row that may be on one sign or on several.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Run {
    /// The words.
    pub words: Vec<Word>,
}

impl Run {
    /// Whether it is a name: one of the words is, and more than a word for a place, as Main Street is.
    pub fn is_name(&self) -> bool {
        let names = self.words.iter().filter(|word| word.is_name);
        names.clone().count() > 1 || names.clone().any(|word| !word.is_common)
    }

    /// The words from the first to the last that is a name.
    pub fn name(&self) -> String {
        let is_name = |word: &Word| word.is_name;
        let first = self.words.iter().position(is_name).unwrap_or(0);
        let end = self.words.iter().rposition(is_name).map_or(0, |last| last + 1);
        Self { words: self.words[first..end.max(first)].to_vec() }.text()
    }

    /// The words with spaces between them.
    pub fn text(&self) -> String {
        let words: Vec<&str> = self.words.iter().map(|word| word.text.as_str()).collect();
        words.join(" ")
    }
}

/// Opening quotation marks and what closes them.
const QUOTES: [(char, &[char]); 9] = [
    ('"', &['"']),
    ('“', &['”', '“']),
    ('„', &['“', '”']),
    ('«', &['»']),
    ('»', &['«']),
    ('「', &['」']),
    ('『', &['』']),
    ('‘', &['’', '‘']),
    ('\'', &['\'']),
];

/// What ends a sentence.
const STOPS: [char; 7] = ['.', '!', '?', '\n', '。', '！', '？'];

/// Stands for each character of a quotation in the rest of a text.
const QUOTED: char = '\u{1}';

/// The most characters between quotation marks. Longer passages are quotations of something other than a sign.
const LONGEST_QUOTE: usize = 60;

/// The runs of words that may be on signs: all but function words and words about where things are. At most [`MAX_WORDS`].
pub fn runs(text: &str) -> Vec<Run> {
    let chars: Vec<char> = text.chars().collect();
    let (outside, quoted) = split_quotes(&chars);
    let tokens = tokens(&outside);
    let has_small = text.chars().any(char::is_lowercase);
    let in_german =
        tokens.iter().flatten().filter(|token| common::is_german(&plain(&token.text))).count() >= 2;
    let mut found: Vec<(usize, Run)> = Vec::new();
    // What is not there, from a negation to the end of its clause.
    let mut negated: Vec<Range<usize>> = Vec::new();
    for sentence in tokens {
        let (mut is_continued, mut negated_from) = (false, None);
        for Token { text, at, is_first, before } in sentence {
            let folded = folded(&text);
            if before == Before::Mark || common::is_contrast(&folded) {
                negated.extend(negated_from.take().map(|from| from..at));
            }
            if common::is_negation(&folded) {
                negated_from = negated_from.or(Some(at));
            }
            // A single letter is a word of a sentence, or a label on a plan.
            if common::is_function_word(&folded) || folded.len() == 1 {
                is_continued = false;
                continue;
            }
            if before > Before::Space || !is_continued {
                found.push((at, Run::default()));
            }
            let is_name = has_small && is_written_as_name(&text, is_first || in_german);
            if let Some((_, run)) = found.last_mut() {
                run.words.push(Word { is_name, is_common: common::is_place_word(&folded), text });
            }
            is_continued = true;
        }
        negated.extend(negated_from.map(|from| from..end_of_sentence(&outside, from)));
    }
    for (at, quote) in quoted {
        let word = |text: &str| Word { text: text.into(), is_name: true, is_common: false };
        let words = quote.split_whitespace().filter(|word| has_letter(word));
        found.push((at, Run { words: words.map(word).collect() }));
    }
    found.retain(|(at, _)| !negated.iter().any(|span| span.contains(at)));
    found.sort_by_key(|(at, _)| *at);
    let mut left = MAX_WORDS;
    let mut runs = Vec::new();
    for (_, mut run) in found {
        run.words.truncate(left);
        left -= run.words.len();
        if !run.words.is_empty() {
            runs.push(run);
        }
    }
    runs
}

fn has_letter(word: &str) -> bool {
    word.chars().any(char::is_alphanumeric)
}

/// The text with each quotation replaced by [`QUOTED`], and the quotations with where they begin.
fn split_quotes(chars: &[char]) -> (Vec<char>, Vec<(usize, String)>) {
    let mut outside = chars.to_vec();
    let mut quoted = Vec::new();
    let is_letter = |at: usize| chars.get(at).is_some_and(|c| c.is_alphanumeric());
    let mut at = 0;
    while at < chars.len() {
        let quote = QUOTES.iter().find(|(open, _)| *open == chars[at]);
        // The apostrophe of MARIO'S opens nothing, and neither closes anything.
        let opens = quote.filter(|_| at == 0 || !is_letter(at - 1) || chars[at] > '\u{2fff}');
        let longest = (at + 1 + LONGEST_QUOTE).min(chars.len());
        let end = opens.and_then(|(_, closing)| {
            let closes = |end: &usize| closing.contains(&chars[*end]);
            let is_apostrophe = |end: &usize| {
                ['\'', '’'].contains(&chars[*end]) && is_letter(end - 1) && is_letter(end + 1)
            };
            (at + 1..longest).filter(|end| !is_apostrophe(end)).find(closes)
        });
        match end {
            Some(end) if (at + 1..end).any(is_letter) => {
                quoted.push((at, chars[at + 1..end].iter().collect()));
                outside[at..=end].fill(QUOTED);
                at = end + 1;
            }
            _ => at += 1,
        }
    }
    (outside, quoted)
}

/// Where the sentence ends that has the character at `from`.
fn end_of_sentence(chars: &[char], from: usize) -> usize {
    chars[from..].iter().position(|c| STOPS.contains(c)).map_or(chars.len(), |at| from + at)
}

/// A word, or a number, of a text.
struct Token {
    text: String,
    at: usize,
    /// Whether it is the first of its sentence.
    is_first: bool,
    /// What is between it and the word before.
    before: Before,
}

/// What is between two words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Before {
    Space,
    Quote,
    Mark,
}

/// The words, sentence by sentence.
fn tokens(chars: &[char]) -> Vec<Vec<Token>> {
    let mut sentences = vec![Vec::new()];
    let (mut is_first, mut before) = (true, Before::Space);
    let mut at = 0;
    while at < chars.len() {
        let character = chars[at];
        if character.is_alphanumeric() {
            let end = end_of_word(chars, at);
            if let Some(sentence) = sentences.last_mut() {
                let text = chars[at..end].iter().collect();
                sentence.push(Token { text, at, is_first, before });
            }
            (is_first, before, at) = (false, Before::Space, end);
            continue;
        }
        match character {
            c if STOPS.contains(&c) => {
                sentences.push(Vec::new());
                (is_first, before) = (true, Before::Space);
            }
            c if c.is_whitespace() || matches!(c, '\'' | '’') => {}
            // The next word is not the first of its sentence.
            QUOTED => (is_first, before) = (false, before.max(Before::Quote)),
            _ => before = Before::Mark,
        }
        at += 1;
    }
    sentences
}

/// A word in lower case without accents, and without what English puts behind an apostrophe.
fn folded(word: &str) -> String {
    let plain = plain(word).replace('’', "'");
    match plain.strip_suffix("'s") {
        Some(stem) if common::is_function_word(stem) || common::is_place_word(stem) => stem.into(),
        _ => plain.replace('\'', ""),
    }
}

/// What French and Italian put before an apostrophe.
const ELIDED: [&str; 17] = [
    "l", "d", "j", "qu", "c", "s", "n", "m", "t", "un", "dell", "all", "nell", "sull", "dall",
    "quell", "jusqu",
];

/// Where the word ends that begins at `start`: words of scripts without spaces are not told apart.
fn end_of_word(chars: &[char], start: usize) -> usize {
    let is_letter = |at: usize| chars.get(at).is_some_and(|c| c.is_alphanumeric());
    let without_spaces = is_ideographic(chars[start]);
    let mut end = start;
    loop {
        let joins = |c: char| matches!(c, '\'' | '’' | '-' | '&' | '\u{300}'..='\u{36f}');
        match chars.get(end) {
            Some(c) if c.is_alphanumeric() && is_ideographic(*c) == without_spaces => end += 1,
            Some('\u{300}'..='\u{36f}') => end += 1,
            Some(&c) if !without_spaces && joins(c) && is_letter(end + 1) => {
                let so_far = chars[start..end].iter().collect::<String>().to_lowercase();
                if matches!(c, '\'' | '’') && ELIDED.contains(&so_far.as_str()) {
                    return end;
                }
                end += 1;
            }
            _ => return end,
        }
    }
}

/// Whether a word is written as names are. `capital_says_nothing`: at the start of a sentence, and in German.
fn is_written_as_name(word: &str, capital_says_nothing: bool) -> bool {
    let letters: Vec<char> = word.chars().filter(|c| c.is_alphabetic()).collect();
    let Some((first, rest)) = letters.split_first() else { return false };
    let capitals_after = rest.iter().filter(|c| c.is_uppercase()).count();
    capitals_after > 0 || (first.is_uppercase() && !capital_says_nothing && !rest.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The runs of a text, names in brackets.
    fn found(text: &str) -> Vec<String> {
        let word = |word: &Word| match (word.is_name, word.is_common) {
            (true, _) => format!("[{}]", word.text),
            (false, true) => format!("({})", word.text),
            (false, false) => word.text.clone(),
        };
        let run = |run: &Run| run.words.iter().map(word).collect::<Vec<_>>().join(" ");
        runs(text).iter().map(run).collect()
    }

    #[test]
    fn what_may_be_on_signs_is_told_from_the_rest() {
        for (text, expected) in [
            // The example of the paper.
            (
                "There is a McDonald's and a Starbucks on different sides",
                &["[McDonald's]", "[Starbucks]", "different (sides)"][..],
            ),
            (
                "opposite the pharmacy, KAWA COFFEE is on its left",
                &["(opposite)", "pharmacy", "[KAWA] [COFFEE]", "(left)"],
            ),
            (
                "I'm at the corner of Main Street and 5th Avenue",
                &["(corner)", "[Main] [Street]", "5th [Avenue]"],
            ),
            (
                "a sign says \"open 24 hours\" next to a bank",
                &["(sign) (says)", "[open] [24] [hours]", "(next)", "bank"],
            ),
            (
                "“Kawa Coffee”, 'Mario's' and „Bäckerei“",
                &["[Kawa] [Coffee]", "[Mario's]", "[Bäckerei]"],
            ),
            (
                "ich stehe neben der Apotheke, links «REWE City»",
                &["(stehe) (neben)", "Apotheke", "(links)", "[REWE] [City]"],
            ),
            (
                "à côté de l'Hôtel d'Orsay et de la boulangerie",
                &["(côté)", "[Hôtel]", "[Orsay]", "boulangerie"],
            ),
            ("junto a la Farmacia Gran Vía", &["(junto)", "[Farmacia] [Gran] [Vía]"]),
            ("vicino al Bar dell'Angelo", &["(vicino)", "[Bar]", "[Angelo]"]),
            ("I SEE KAWA COFFEE ON THE LEFT", &["(SEE) KAWA COFFEE", "(LEFT)"]),
            ("kawa coffee", &["kawa coffee"]),
            ("Pharmacy", &["Pharmacy"]),
            ("我在「星巴克」旁边", &["我在", "[星巴克]", "旁边"]),
            ("7-Eleven and AT&T", &["7-Eleven", "[AT&T]"]),
            ("don't know where I am", &["know"]),
            ("a b c 1", &[]),
            ("...", &[]),
            ("\"\"", &[]),
        ] {
            assert_eq!(found(text), expected, "{text}");
        }
    }

    #[test]
    fn what_is_not_there_is_left_out() {
        for (text, expected) in [
            ("I see no pharmacy or bank, but KAWA is here", &["(see)", "[KAWA]"][..]),
            ("there is no \"Kawa\" here. A bakery", &["bakery"]),
            ("not far from MARIO'S", &["(far)", "[MARIO'S]"]),
            ("neben dem Hotel, keine Apotheke", &["(neben)", "Hotel"]),
            ("sans pharmacie mais une boulangerie", &["boulangerie"]),
            ("sin farmacia", &[]),
        ] {
            assert_eq!(found(text), expected, "{text}");
        }
    }

    #[test]
    fn a_long_description_is_bounded() {
        let text = "kawa coffee, ".repeat(100);
        let words: usize = runs(&text).iter().map(|run| run.words.len()).sum();
        assert_eq!(words, MAX_WORDS);
        let quote = format!("\"{}\"", "long ".repeat(50));
        assert!(runs(&quote).iter().all(|run| !run.is_name()), "no sign is that long");
    }

    #[test]
    fn a_word_for_a_place_is_no_name_by_itself() {
        let is_name = |text: &str| runs(text).iter().any(Run::is_name);
        assert!(is_name("in Main Street") && is_name("at \"Shop\""));
        assert!(!is_name("at the Shop") && !is_name("the left side"));
    }
}
