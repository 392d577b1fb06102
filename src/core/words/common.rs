//! Words that say nothing about a sign: function words, and what people write about where things are, in English, German,
//! French, Spanish and Italian.

/// Function words, in lower case, without accents.
const FUNCTION: &str = include_str!("function.txt");

/// What people write about where things are and what they look like, in lower case, without accents.
const PLACE: &str = include_str!("place.txt");

/// Function words that only German has, of those above.
const GERMAN: &str = include_str!("german.txt");

/// Whether a word says nothing about a sign, whatever its case. `word` is in lower case, without accents.
pub(super) fn is_function_word(word: &str) -> bool {
    FUNCTION.split_ascii_whitespace().any(|one| one == word)
}

/// Whether a word describes a place rather than naming it, unless it is part of a name. `word` is in lower case, without
/// accents.
pub(super) fn is_place_word(word: &str) -> bool {
    PLACE.split_ascii_whitespace().any(|one| one == word)
}

/// Whether a word is German. `word` is in lower case, without accents.
pub(super) fn is_german(word: &str) -> bool {
    GERMAN.split_ascii_whitespace().any(|one| one == word)
}
