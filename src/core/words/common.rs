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

/// Words by which what follows is said not to be there. Not is none of them: not far from the bank.
const NEGATIONS: [&str; 11] =
    ["no", "without", "neither", "nor", "none", "kein", "keine", "ohne", "sans", "sin", "senza"];

/// Words that end what a negation is about.
const CONTRASTS: [&str; 6] = ["but", "aber", "sondern", "mais", "pero", "ma"];

/// Whether a word says that something is not there. `word` is in lower case, without accents and apostrophes.
pub(super) fn is_negation(word: &str) -> bool {
    NEGATIONS.contains(&word)
}

/// Whether a word ends what a negation is about. `word` is in lower case, without accents.
pub(super) fn is_contrast(word: &str) -> bool {
    CONTRASTS.contains(&word)
}
