//! The description of a pair: how much agrees, where, how it moved, what has no counterpart, and a verdict.

use super::signs::SignEvidence;
use super::{Motion, PairMatch};
use whereabouts_core::TextLine;

/// The most signs that a sentence names.
const SIGNS_NAMED: usize = 3;

/// The names of the ninths of a picture, row by row.
const NINTHS: [&str; 9] = [
    "upper left",
    "top",
    "upper right",
    "left",
    "centre",
    "right",
    "lower left",
    "bottom",
    "lower right",
];

/// The names of whole rows and columns of ninths.
const STRIPS: [([usize; 3], &str); 6] = [
    ([0, 1, 2], "along the top edge"),
    ([6, 7, 8], "along the bottom edge"),
    ([0, 3, 6], "along the left edge"),
    ([2, 5, 8], "along the right edge"),
    ([3, 4, 5], "across the middle"),
    ([1, 4, 7], "down the middle"),
];

/// The share of the pictures of other places of the map, of those that agree most with their frames, from which there is
/// some agreement.
const SOME: f32 = 0.5;

/// How the agreement of a pair compares with that of wrong answers of the map. The words of the verdict rest on the same
/// measurement as the confidence of an estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Standing {
    /// The confidence of the pair; `None` while it is not measured how much wrong answers agree, and for a frame that
    /// shows nothing. There is no verdict then: the estimate says why.
    pub confidence: Option<f32>,
    /// The confidence from which a place is known.
    pub known_from: f64,
}

/// Describes one pair in plain English, in two to six sentences. The same pair always gives the same
/// text. The console reads these texts, so their wording is part of its contract (`words.js`).
pub fn describe(pair: &PairMatch, standing: Standing) -> String {
    if pair.matches.is_empty() {
        return nothing_agrees(pair);
    }
    let parts = Parts::of(pair);
    let mut sentences = vec![how_much(pair), parts.agreement()];
    sentences.extend(distinctiveness(pair));
    sentences.push(movement(pair));
    sentences.push(parts.gaps());
    sentences.extend(verdict(standing));
    sentences.join(" ")
}

/// Says which signs of the frame a candidate shows, in at most two sentences, each with a space before it.
pub fn describe_signs(frame: &[TextLine], signs: &SignEvidence) -> String {
    let named = |lines: &[usize]| -> Vec<String> {
        let most = lines.iter().take(SIGNS_NAMED).filter_map(|&line| frame.get(line));
        most.map(|line| format!("\u{2018}{}\u{2019} ({})", line.text, ninth(line))).collect()
    };
    let mut said = String::new();
    if !signs.shared.is_empty() {
        let noun = if signs.shared.len() == 1 { "sign" } else { "signs" };
        said += &format!(" Both show the {noun} {}.", list(&named(&signs.shared)));
    }
    if !signs.missing.is_empty() {
        let missing = list(&named(&signs.missing));
        let verb = if signs.missing.len() == 1 { "is" } else { "are" };
        said += &format!(" The frame's {missing} {verb} missing from the candidate.");
    }
    said
}

/// The part of the picture where a line is.
fn ninth(line: &TextLine) -> &'static str {
    let [x, y] =
        [0, 1].map(|axis| line.corners.iter().map(|corner| corner[axis]).sum::<f32>() / 4.0);
    let third = |at: f32| ((at * 3.0) as usize).min(2);
    NINTHS[third(y) * 3 + third(x)]
}

fn nothing_agrees(pair: &PairMatch) -> String {
    format!(
        "None of the {} of the query has a counterpart in the candidate that moved together with \
         its surroundings. {} resembled each other best, but not in the \
         same arrangement. There is no sign that this is the same place.",
        regions(pair.cells),
        pairs_of_regions(pair.mutual),
    )
}

fn how_much(pair: &PairMatch) -> String {
    format!(
        "{} of {} of the query ({} % of them) have a counterpart in the candidate that moved together \
         with its surroundings; {} more resembled each other but not in the same arrangement.",
        pair.matches.len(),
        regions(pair.cells),
        percent(share(pair)),
        pair.mutual.saturating_sub(pair.matches.len()),
    )
}

fn distinctiveness(pair: &PairMatch) -> Option<String> {
    let among = match pair.rivals {
        0 => return None,
        1 => "in the other candidate".to_owned(),
        rivals => format!("in any of the other {rivals} candidates"),
    };
    Some(format!("{} of them have no better counterpart {among}.", pair.distinctive))
}

fn movement(pair: &PairMatch) -> String {
    let follow = percent(pair.motion.support as f32 / pair.matches.len().max(1) as f32);
    let changes = Changes::of(&pair.motion);
    let rest = match follow {
        90.. => "",
        50.. => "; the others moved by other amounts, as nearer and farther things do",
        _ => "; most moved otherwise, so this says little",
    };
    let cause = changes.viewpoint();
    format!(
        "Seen from the query to the candidate, {follow} % of the agreeing regions {}{}{rest}.",
        changes.seen(),
        if cause.is_empty() { String::new() } else { format!(", as if the candidate was {cause}") },
    )
}

/// Judges by how often a wrong answer of the map agrees as much, and not by the number of matches: a candidate that
/// shares only the lens rim and the floor with the query has many matches.
fn verdict(standing: Standing) -> Option<String> {
    let confidence = standing.confidence?;
    // Rounded down, as the confidence is shown.
    let less = format!(
        "{} % of the best wrong answers in this map agree less",
        (confidence * 100.0 + 1e-4) as usize
    );
    Some(if confidence >= standing.known_from as f32 {
        format!("Strong agreement: {less}, so this is probably the same place.")
    } else if confidence >= SOME {
        format!("Some agreement: {less}, so this is possibly the same place, or one built like it.")
    } else {
        format!("Weak agreement: {less}, so what matches may be chance or a repeated pattern.")
    })
}

fn share(pair: &PairMatch) -> f32 {
    pair.matches.len() as f32 / pair.cells.max(1) as f32
}

fn percent(share: f32) -> usize {
    (share * 100.0).round() as usize
}

fn regions(count: usize) -> String {
    if count == 1 { "1 region".to_owned() } else { format!("{count} regions") }
}

fn pairs_of_regions(count: usize) -> String {
    if count == 1 { "1 pair of regions".to_owned() } else { format!("{count} pairs of regions") }
}

/// The share of agreeing cells in each ninth of the query.
struct Parts([f32; 9]);

impl Parts {
    fn of(pair: &PairMatch) -> Self {
        let mut counts = [0usize; 9];
        for found in &pair.matches {
            let [column, row] = found.query.map(|x| ((x * 3.0) as usize).min(2));
            counts[row * 3 + column] += 1;
        }
        let cells = pair.cells.max(1) as f32 / 9.0;
        Self(counts.map(|count| count as f32 / cells))
    }

    fn agreement(&self) -> String {
        let best = self.0.into_iter().fold(0.0, f32::max);
        let chosen = self.0.map(|share| share >= 0.5 * best);
        format!("They lie mostly {}.", places(chosen))
    }

    fn gaps(&self) -> String {
        let empty = self.0.map(|share| share < 0.03);
        if empty.contains(&true) {
            format!("Hardly anything {} found a counterpart.", places(empty))
        } else {
            "No part of the picture is without a counterpart.".to_owned()
        }
    }
}

/// Names a choice of ninths: whole strips first, then single ninths.
fn places(chosen: [bool; 9]) -> String {
    if chosen == [true; 9] {
        return "all over the picture".to_owned();
    }
    let mut unnamed = chosen;
    let mut names: Vec<String> = Vec::new();
    for (strip, name) in STRIPS {
        if strip.iter().all(|&ninth| chosen[ninth]) && strip.iter().any(|&ninth| unnamed[ninth]) {
            strip.iter().for_each(|&ninth| unnamed[ninth] = false);
            names.push(name.to_owned());
        }
    }
    let single: Vec<&str> =
        NINTHS.iter().zip(unnamed).filter(|(_, unnamed)| *unnamed).map(|(name, _)| *name).collect();
    if !single.is_empty() {
        names.push(format!("in the {}", list(&single)));
    }
    list(&names)
}

/// Joins names to `a`, `a and b`, `a, b and c`.
fn list(names: &[impl AsRef<str>]) -> String {
    match names {
        [] => String::new(),
        [only] => only.as_ref().to_owned(),
        [first @ .., last] => {
            let first: Vec<&str> = first.iter().map(AsRef::as_ref).collect();
            format!("{} and {}", first.join(", "), last.as_ref())
        }
    }
}

/// A motion rounded for a reader; changes too small to be seen are 0.
struct Changes {
    /// Percent of the edges, right and down positive.
    shift: [i32; 2],
    scale: f32,
    /// Degrees, clockwise positive.
    rotation: i32,
}

impl Changes {
    fn of(motion: &Motion) -> Self {
        let visible = |amount: f32, least: f32| {
            if amount.abs() < least { 0 } else { amount.round() as i32 }
        };
        let scale = motion.scale();
        Self {
            shift: motion.shift().map(|x| visible(x * 100.0, 2.0)),
            scale: if (0.95..=1.05).contains(&scale) { 1.0 } else { scale },
            rotation: visible(motion.rotation(), 3.0),
        }
    }

    /// Says how the regions moved.
    fn seen(&self) -> String {
        let mut seen = Vec::new();
        let [x, y] = self.shift;
        if x != 0 {
            let side = if x < 0 { "left" } else { "right" };
            seen.push(format!("shifted {} % of the width to the {side}", x.abs()));
        }
        if y != 0 {
            let side = if y < 0 { "up" } else { "down" };
            seen.push(format!("shifted {} % of the height {side}", y.abs()));
        }
        if self.scale > 1.0 {
            seen.push(format!("became {:.1} times larger", self.scale));
        } else if self.scale < 1.0 {
            seen.push(format!("became {:.1} times smaller", 1.0 / self.scale));
        }
        if self.rotation != 0 {
            let way = if self.rotation > 0 { "clockwise" } else { "anticlockwise" };
            seen.push(format!("turned {}° {way}", self.rotation.abs()));
        }
        if seen.is_empty() { "stayed where they were".to_owned() } else { list(&seen) }
    }

    /// Says where the camera must have been. A turn and a step to the side look alike.
    fn viewpoint(&self) -> String {
        let mut from = Vec::new();
        if self.scale > 1.0 {
            from.push("closer");
        } else if self.scale < 1.0 {
            from.push("farther back");
        }
        match self.shift[0] {
            ..0 => from.push("further right or turned to the right"),
            0 => {}
            1.. => from.push("further left or turned to the left"),
        }
        if from.is_empty() { String::new() } else { format!("taken from {}", list(&from)) }
    }
}
