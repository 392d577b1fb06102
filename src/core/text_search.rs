//! Search in texts that were read: what people type seldom equals what was read.
//!
//! Readers take 0 for O, 1 for l and rn for m, lose spaces, accents and apostrophes, and read one sign as two lines.
//! [`Folded`] makes such spellings equal, [`grams`] finds the images that may match in an index, and [`TextQuery`]
//! decides which do and how well. A store only counts grams, so every store finds the same.

use std::collections::BTreeSet;

use serde::Serialize;
use unicode_normalization::UnicodeNormalization;
use utoipa::ToSchema;

use super::TextLine;

/// How well a text must match, from 0 to 1.
pub const LEAST_SCORE: f32 = 0.5;

/// What a match that needs only some of the words, or words in another order, is worth at most.
const WORDS_WORTH: f32 = 0.9;

/// The share of the score that depends on how much of the line is the text that was searched for.
const WHOLE_LINE_WORTH: f32 = 0.2;

/// The share of the score that is for a text without letters that readers confuse.
const EXACT_WORTH: f32 = 0.05;

/// A text without what readers and writers get wrong: case, width, accents, punctuation, spaces, and characters that look
/// alike.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Folded {
    /// The characters, without spaces.
    pub chars: Vec<char>,
    /// The ends of the words in it.
    pub word_ends: Vec<usize>,
}

impl Folded {
    /// Folds a text.
    pub fn new(text: &str) -> Self {
        let mut chars = Vec::new();
        let mut word_ends = Vec::new();
        let end = |chars: &Vec<char>, ends: &mut Vec<usize>| {
            if chars.len() > ends.last().copied().unwrap_or(0) {
                ends.push(chars.len());
            }
        };
        for character in plain(text).chars() {
            match character {
                // MARIO'S is also read as MARIOS.
                '\'' | '\u{2019}' | '\u{2018}' | '`' | '\u{b4}' => {}
                _ if is_ideographic(character) => {
                    end(&chars, &mut word_ends);
                    chars.push(character);
                }
                _ if character.is_alphanumeric() || character == '|' => {
                    if chars.last().is_some_and(|&last| is_ideographic(last)) {
                        end(&chars, &mut word_ends);
                    }
                    push_lookalike(&mut chars, &word_ends, character);
                }
                _ => end(&chars, &mut word_ends),
            }
        }
        end(&chars, &mut word_ends);
        Self { chars, word_ends }
    }

    /// The words.
    pub fn words(&self) -> impl Iterator<Item = &[char]> {
        let starts = std::iter::once(&0).chain(&self.word_ends);
        starts.zip(&self.word_ends).map(|(&start, &end)| &self.chars[start..end])
    }

    /// This text and another one behind it.
    fn followed_by(&self, other: &Self) -> Self {
        let shift = self.chars.len();
        Self {
            chars: [self.chars.as_slice(), &other.chars].concat(),
            word_ends: self
                .word_ends
                .iter()
                .copied()
                .chain(other.word_ends.iter().map(|end| end + shift))
                .collect(),
        }
    }

    /// Whether nothing is left.
    pub fn is_empty(&self) -> bool {
        self.chars.is_empty()
    }

    /// The same as text, for keys.
    pub fn key(&self) -> String {
        self.chars.iter().collect()
    }
}

/// Case, width and accents folded.
pub(super) fn plain(text: &str) -> String {
    let is_accent = |c: char| ('\u{300}'..='\u{36f}').contains(&c);
    let mut folded = String::with_capacity(text.len());
    for character in text.nfkd().filter(|&c| !is_accent(c)).nfc().flat_map(char::to_lowercase) {
        match character {
            'ß' => folded.push_str("ss"),
            'æ' => folded.push_str("ae"),
            'œ' => folded.push_str("oe"),
            'ø' => folded.push('o'),
            'ł' => folded.push('l'),
            'đ' | 'ð' => folded.push('d'),
            'ı' => folded.push('i'),
            // Lower case of a capital with a dot.
            c if is_accent(c) => {}
            c => folded.push(c),
        }
    }
    folded
}

/// Adds a character as the one that it is taken for. No two digits become one.
fn push_lookalike(chars: &mut Vec<char>, word_ends: &[usize], character: char) {
    let start = word_ends.last().copied().unwrap_or(0);
    let same = match character {
        '0' | 'о' | 'ο' => 'o',
        '1' | 'i' | '|' | 'і' | 'ι' => 'l',
        '5' | 'ѕ' => 's',
        '8' => 'b',
        '2' => 'z',
        'а' | 'α' => 'a',
        'е' => 'e',
        'р' | 'ρ' => 'p',
        'с' => 'c',
        'х' => 'x',
        'у' => 'y',
        'ー' => '一',
        other => other,
    };
    let last = chars.last().copied().filter(|_| chars.len() > start);
    match (last, same) {
        (Some('r'), 'n') => replace_last(chars, 'm'),
        (Some('v'), 'v') => replace_last(chars, 'w'),
        _ => chars.push(same),
    }
}

fn replace_last(chars: &mut [char], by: char) {
    if let Some(last) = chars.last_mut() {
        *last = by;
    }
}

/// Whether words of the script are short, or written without spaces: Han, kana, Hangul, Thai, Lao, Khmer and Burmese.
pub(super) fn is_ideographic(character: char) -> bool {
    matches!(u32::from(character),
        0x0E00..=0x0EFF | 0x1000..=0x109F | 0x1780..=0x17FF | 0x3005..=0x3007 | 0x3040..=0x30FF
        | 0x3400..=0x4DBF | 0x4E00..=0x9FFF | 0xAC00..=0xD7AF | 0xF900..=0xFAFF | 0x20000..=0x3FFFF)
}

/// The grams by which an index finds lines: pairs of characters, and single ones of scripts without spaces and of words
/// of one character, each hashed. The lines of a sign that was read as two are also joined.
pub fn grams<'a>(lines: impl IntoIterator<Item = &'a str>) -> BTreeSet<u32> {
    let mut found = BTreeSet::new();
    let mut last: Option<char> = None;
    for line in lines {
        let folded = Folded::new(line);
        for word in folded.words().filter(|word| word.len() == 1) {
            found.insert(hash(word));
        }
        let chars = folded.chars;
        if let (Some(last), Some(&first)) = (last, chars.first()) {
            found.insert(hash(&[last, first]));
        }
        for pair in chars.windows(2) {
            found.insert(hash(pair));
        }
        last = chars.last().copied().or(last);
    }
    found
}

/// FNV-1a.
fn hash(chars: &[char]) -> u32 {
    let bytes = chars.iter().flat_map(|c| u32::from(*c).to_le_bytes());
    bytes.fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

/// A line that matches, or two that do together.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct TextMatch {
    /// How well it matches, from 0 to 1: 1 for a line that is the text.
    pub score: f32,
    /// The lines that match, by their number in the image, from 0.
    pub lines: Vec<usize>,
}

/// A text that is searched for.
#[derive(Debug, Clone)]
pub struct TextQuery {
    plain: String,
    folded: Folded,
}

impl TextQuery {
    /// Returns `None` if the text has neither letters nor digits.
    pub fn new(text: &str) -> Option<Self> {
        let folded = Folded::new(text);
        (!folded.is_empty()).then(|| Self { plain: squeezed(text), folded })
    }

    /// The grams that an image shares with the text if it matches.
    pub fn grams(text: &str) -> BTreeSet<u32> {
        grams([text])
    }

    /// How well the lines of an image match; `None` if they do not.
    pub fn matches(&self, lines: &[TextLine]) -> Option<TextMatch> {
        let folded: Vec<Folded> = lines.iter().map(|line| Folded::new(&line.text)).collect();
        let singles = (0..lines.len()).map(|at| (vec![at], folded[at].clone()));
        let joined =
            (1..lines.len()).map(|at| (vec![at - 1, at], folded[at - 1].followed_by(&folded[at])));
        let mut best: Option<TextMatch> = None;
        let mut keep = |score: f32, at: Vec<usize>| {
            // Fewer lines are preferred, then earlier ones.
            let is_better = best.as_ref().is_none_or(|best| score > best.score + 1e-4);
            if score >= LEAST_SCORE && is_better {
                best = Some(TextMatch { score, lines: at });
            }
        };
        for (at, line) in singles.chain(joined) {
            if let Some(likeness) = likeness(&self.folded.chars, &line) {
                let plain: String = at.iter().map(|&at| squeezed(&lines[at].text)).collect();
                let exact = if plain.contains(&self.plain) { EXACT_WORTH } else { 0.0 };
                let share = self.folded.chars.len() as f32 / line.chars.len().max(1) as f32;
                let whole = 1.0 - WHOLE_LINE_WORTH * (1.0 - share.min(1.0));
                keep(likeness * whole * (1.0 - EXACT_WORTH) + exact * whole, at);
            }
        }
        if self.folded.word_ends.len() > 1
            && let Some((score, at)) = self.by_words(&folded)
        {
            keep(score, at);
        }
        best
    }

    /// How many of the words are somewhere in the lines.
    fn by_words(&self, lines: &[Folded]) -> Option<(f32, Vec<usize>)> {
        let (mut found, mut at) = (0.0, BTreeSet::new());
        for word in self.folded.words() {
            let mut best: Option<(f32, usize)> = None;
            for (number, line) in lines.iter().enumerate() {
                if let Some(near) = likeness(word, line)
                    && best.is_none_or(|(score, _)| near > score)
                {
                    best = Some((near, number));
                }
            }
            if let Some((score, number)) = best {
                found += score * word.len() as f32;
                at.insert(number);
            }
        }
        let score = WORDS_WORTH * found / self.folded.chars.len() as f32;
        (!at.is_empty()).then(|| (score, at.into_iter().collect()))
    }
}

/// Lower case, width and accents folded, without spaces.
fn squeezed(text: &str) -> String {
    plain(text).chars().filter(|c| c.is_alphanumeric()).collect()
}

/// The most edits with which a text of this many characters is still the same.
pub fn allowed_edits(chars: usize) -> usize {
    match chars {
        0..=3 => 0,
        4..=6 => 1,
        7..=10 => 2,
        more => more / 4,
    }
}

/// The most letters of a text that must be words of their own. Within other words, short texts are found by chance: BAR
/// in BARBER.
const SHORT: usize = 3;

/// The most letters of a text that must be words of their own if they are not all right: BANK is one edit from a part of
/// BAKER & SON.
const SHORT_IF_WRONG: usize = 6;

/// How much of `text` is somewhere in `line`, from 0 to 1; `None` if too many characters differ, or if the text is short
/// and is no word of the line.
pub fn likeness(text: &[char], line: &Folded) -> Option<f32> {
    if text.is_empty() || line.is_empty() {
        return None;
    }
    let mut edits = match text.len() {
        0..=SHORT => edits_within(text, line, true),
        _ => edits_within(text, line, false),
    };
    if edits > 0 && text.len() <= SHORT_IF_WRONG {
        edits = edits_within(text, line, true);
    }
    (edits <= allowed_edits(text.len())).then(|| 1.0 - edits as f32 / text.len() as f32)
}

/// The fewest insertions, deletions, replacements and swaps of neighbours that turn `text` into a part of `line`: any
/// part, or one that begins and ends with words.
fn edits_within(text: &[char], line: &Folded, whole_words: bool) -> usize {
    let Folded { chars, word_ends } = line;
    let is_bound = |at: usize| !whole_words || at == 0 || word_ends.binary_search(&at).is_ok();
    // A column for each character of the line. A match may begin at each bound, and end there.
    let height = text.len() + 1;
    let mut before: Vec<usize> = (0..height).collect();
    let mut earlier = before.clone();
    let mut fewest = text.len();
    for (at, &character) in chars.iter().enumerate() {
        let mut column = vec![0; height];
        column[0] = if is_bound(at + 1) { 0 } else { before[0] + 1 };
        for row in 1..height {
            let replaced = before[row - 1] + usize::from(text[row - 1] != character);
            let mut least = replaced.min(before[row] + 1).min(column[row - 1] + 1);
            let is_swap =
                row > 1 && at > 0 && text[row - 1] == chars[at - 1] && text[row - 2] == character;
            if is_swap {
                least = least.min(earlier[row - 2] + 1);
            }
            column[row] = least;
        }
        if is_bound(at + 1) {
            fewest = fewest.min(column[text.len()]);
        }
        earlier = std::mem::replace(&mut before, column);
    }
    fewest
}

#[cfg(test)]
mod tests;
