//! Which lines that were read in images say what a description says.

use std::collections::BTreeMap;

use super::{Run, Word};
use crate::TextLine;
use crate::text_search::{Folded, TextMatch, TextQuery, is_ideographic, likeness};

/// The most words of one sign.
const LONGEST_SIGN: usize = 4;

/// How well a line must match a name.
const LEAST_OF_NAME: f32 = 0.6;

/// The most characters of a word that must be spelled as on the sign, if nothing says that it is a name.
const SHORT_WORD: usize = 6;

/// A sign that a description names.
#[derive(Debug, Clone, PartialEq)]
pub struct Sign {
    /// What the description says.
    pub text: String,
    /// Whether it is a name by how it is written.
    pub is_name: bool,
    /// The images in which it was read; none if it was read nowhere.
    pub images: Vec<SignIn>,
}

/// A sign in an image.
#[derive(Debug, Clone, PartialEq)]
pub struct SignIn {
    /// The image, by its index.
    pub image: usize,
    /// How well its lines match, from 0.5 to 1.
    pub score: f32,
    /// The lines that match, by their number in the image.
    pub lines: Vec<usize>,
}

/// Finds the signs that a description names among the lines of images. The longest phrases are tried first, so that the
/// words of one sign count once. A name that was read nowhere is a sign of no image.
pub fn find_signs(runs: &[Run], images: &[&[TextLine]]) -> Vec<Sign> {
    let mut found: Vec<(String, Sign)> = Vec::new();
    let mut keep = |sign: Sign| {
        let key = Folded::new(&sign.text).key();
        match found.iter_mut().find(|(known, _)| *known == key) {
            Some((_, known)) => known.is_name |= sign.is_name,
            None => found.push((key, sign)),
        }
    };
    for run in runs {
        let signs = match run.words.iter().any(|word| word.text.chars().any(is_ideographic)) {
            true => without_spaces(run, images),
            false => phrases(run, images),
        };
        if signs.is_empty() && run.is_name() {
            keep(Sign { text: run.name(), is_name: true, images: Vec::new() });
        }
        signs.into_iter().for_each(&mut keep);
    }
    found.into_iter().map(|(_, sign)| sign).collect()
}

/// The signs of a run of words, the longest first.
fn phrases(run: &Run, images: &[&[TextLine]]) -> Vec<Sign> {
    let mut signs: Vec<(usize, Sign)> = Vec::new();
    let mut is_used = vec![false; run.words.len()];
    for length in (1..=LONGEST_SIGN.min(run.words.len())).rev() {
        for start in 0..=run.words.len() - length {
            let range = start..start + length;
            let words = &run.words[range.clone()];
            let is_free = !is_used[range.clone()].iter().any(|used| *used);
            if !is_free || !may_be_sign(words) {
                continue;
            }
            let sign = find(words, images);
            if !sign.images.is_empty() {
                is_used[range].fill(true);
                signs.push((start, sign));
            }
        }
    }
    signs.sort_by_key(|(start, _)| *start);
    signs.into_iter().map(|(_, sign)| sign).collect()
}

/// Whether words may be on one sign by themselves: a name does not begin or end with a word for a place that is written
/// small, and a single one is no sign.
fn may_be_sign(words: &[Word]) -> bool {
    let is_prose = |word: &Word| word.is_common && !word.is_name;
    match words {
        [one] => !one.is_common,
        [first, .., last] => words.iter().all(is_prose) || !(is_prose(first) || is_prose(last)),
        [] => false,
    }
}

/// The images in which these words are on one sign.
fn find(words: &[Word], images: &[&[TextLine]]) -> Sign {
    let text = Run { words: words.to_vec() }.text();
    let is_name = words.iter().any(|word| word.is_name);
    let mut sign = Sign { text, is_name, images: Vec::new() };
    let Some(query) = TextQuery::new(&sign.text) else { return sign };
    let folded = Folded::new(&sign.text).chars;
    for (image, lines) in images.iter().enumerate() {
        let Some(TextMatch { score, lines: at }) = query.matches(lines) else { continue };
        // A sign is read as two lines at most. The same letters of a word that is no name are chance in two.
        let most = if is_name || words.len() > 1 { 2 } else { 1 };
        let is_one_sign = at.windows(2).all(|pair| pair[1] - pair[0] == 1) && at.len() <= most;
        let is_exact = || {
            let joined: String = at.iter().map(|&at| format!("{} ", lines[at].text)).collect();
            likeness(&folded, &Folded::new(&joined)).is_some_and(|near| near >= 1.0)
        };
        let is_like = match is_name || folded.len() > SHORT_WORD {
            true => score >= LEAST_OF_NAME,
            false => is_exact(),
        };
        if is_one_sign && is_like {
            sign.images.push(SignIn { image, score, lines: at });
        }
    }
    sign
}

/// The signs in a text of a script without spaces: lines that occur in it.
fn without_spaces(run: &Run, images: &[&[TextLine]]) -> Vec<Sign> {
    let text = Folded::new(&run.text());
    let is_name = run.is_name();
    let mut signs: BTreeMap<Vec<char>, Sign> = BTreeMap::new();
    for (image, lines) in images.iter().enumerate() {
        for (number, line) in lines.iter().enumerate() {
            let folded = Folded::new(&line.text).chars;
            let Some(score) = likeness(&folded, &text).filter(|_| folded.len() > 1) else {
                continue;
            };
            let sign = signs.entry(folded).or_insert_with(|| Sign {
                text: line.text.clone(),
                is_name,
                images: Vec::new(),
            });
            if sign.images.last().is_none_or(|last| last.image != image) {
                sign.images.push(SignIn { image, score, lines: vec![number] });
            }
        }
    }
    // What is part of a longer sign counts once.
    let all: Vec<Vec<char>> = signs.keys().cloned().collect();
    let is_part = |one: &Vec<char>| {
        all.iter().any(|other| {
            other.len() > one.len() && other.windows(one.len()).any(|part| part == one)
        })
    };
    signs.into_iter().filter(|(one, _)| !is_part(one)).map(|(_, sign)| sign).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::text_line::lines;
    use crate::words::runs;

    /// The signs of a text with the images that show them.
    fn signs(text: &str, images: &[&[&str]]) -> Vec<(String, Vec<usize>)> {
        let images: Vec<Vec<TextLine>> = images.iter().map(|texts| lines(texts)).collect();
        let images: Vec<&[TextLine]> = images.iter().map(Vec::as_slice).collect();
        let found = find_signs(&runs(text), &images);
        let shown = |sign: &Sign| sign.images.iter().map(|at| at.image).collect();
        found.iter().map(|sign| (sign.text.clone(), shown(sign))).collect()
    }

    #[test]
    fn signs_are_found_in_images_however_they_are_named() {
        let images: &[&[&str]] = &[
            &["KAWA", "COFFEE", "PHARMACY"],
            &["City Bank"],
            &["PiARMACY", "TOYS"],
            &["東京カフェ", "薬局"],
            &["MAIN STREET"],
            &["BOOKS", "OPTICIAN"],
        ];
        for (text, expected) in [
            (
                "opposite the pharmacy is Kawa Coffee",
                &[("pharmacy", &[0, 2][..]), ("Kawa Coffee", &[0])][..],
            ),
            ("I see city bank", &[("city bank", &[1])]),
            ("on main street", &[("main street", &[4])]),
            ("東京カフェの隣に薬局があります", &[("東京カフェ", &[3]), ("薬局", &[3])]),
            // A name that nothing shows is a sign of no image; other words are not.
            ("between Starbucks and the fountain, Toys", &[("Starbucks", &[]), ("Toys", &[2])]),
            // Named twice, it is one sign.
            ("TOYS, the toys shop", &[("TOYS", &[2])]),
            // The same letters by chance, and words for places.
            ("a bookshop", &[]),
            ("a red bang on the street", &[]),
        ] {
            let expected: Vec<(String, Vec<usize>)> =
                expected.iter().map(|(text, at)| ((*text).into(), at.to_vec())).collect();
            assert_eq!(signs(text, images), expected, "{text}");
        }
    }
}
