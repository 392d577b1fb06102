//! The signs that a frame and its candidates show, as evidence beside the regions.
//!
//! A line that was read in the frame is looked for in each candidate, as a description in words is
//! ([`words`](whereabouts_core::words)): by a Bernoulli model of the signs of each image. The frequency of a sign is that
//! among the candidates, since these are to be told apart.

use whereabouts_core::TextLine;
use whereabouts_core::text_search::{Folded, TextQuery};
use whereabouts_core::words::{sign_frequency, sign_ratio};

/// How much a candidate's share of the votes counts beside the signs: the power of the share.
const VOTES: f64 = 3.0;

/// The share of the lines of a frame that are not read in the image of its place: cut, covered, or read otherwise.
const OTHERS: f64 = 0.5;

/// The least share of the votes; below it, differences are chance.
const LEAST_VOTES: f64 = 1e-3;

/// The least letters of a line that is compared. Shorter ones are often parts of cut signs.
const LEAST_LETTERS: usize = 3;

/// Lines that begin or end within this share of the width from an edge of the picture may be cut off by it.
const EDGE: f32 = 0.04;

/// Standard deviation of ln of how much higher the same sign is in one of two pictures of a place. The camera of a frame may
/// be nearer or farther; a sign of the next place is much smaller.
const SIZES: f64 = 0.5;

/// How well a line must match, from 0 to 1.
const LEAST_SCORE: f32 = 0.6;

/// What the signs of a candidate say.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SignEvidence {
    /// ln of how many times as probable the frame's lines are if this is its place, relative to any of the candidates.
    pub log_ratio: f64,
    /// The lines of the frame that the candidate shows too, by index.
    pub shared: Vec<usize>,
    /// The lines of the frame that other candidates show and this one does not, by index.
    pub missing: Vec<usize>,
}

/// A line of the frame that a candidate shows.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Shown {
    /// The line of the frame, by its place among those that are compared.
    sign: usize,
    /// How well it matches, from 0 to 1.
    worth: f64,
    /// Where it is from left to right: in the frame and in the candidate.
    x: [f32; 2],
}

/// What the signs say about each candidate; `None` if none of the frame's lines tells the candidates apart. A candidate
/// whose text was not read is `None`, and is neither better nor worse for it.
pub fn evidence(
    frame: &[TextLine],
    candidates: &[Option<Vec<TextLine>>],
) -> Option<Vec<SignEvidence>> {
    let signs = signs_of(frame);
    let shown: Vec<Option<Vec<Shown>>> = candidates
        .iter()
        .map(|lines| Some(in_order(shown_in(frame, &signs, lines.as_ref()?))))
        .collect();
    let read = shown.iter().flatten().count();
    let mut found = vec![SignEvidence::default(); candidates.len()];
    let mut tells_apart = false;
    for (sign, &line) in signs.iter().enumerate() {
        let worth = |shown: &Vec<Shown>| {
            shown.iter().find(|shown| shown.sign == sign).map_or(0.0, |shown| shown.worth)
        };
        let worths: Vec<Option<f64>> =
            shown.iter().map(|shown| shown.as_ref().map(worth)).collect();
        let showing = worths.iter().flatten().filter(|worth| **worth > 0.0).count();
        if showing == 0 || showing == read {
            continue;
        }
        tells_apart = true;
        let frequency = sign_frequency(worths.iter().flatten().sum(), read);
        for (worth, evidence) in worths.into_iter().zip(&mut found) {
            let Some(worth) = worth else { continue };
            evidence.log_ratio += sign_ratio(OTHERS, worth, frequency).ln();
            match worth > 0.0 {
                true => evidence.shared.push(line),
                false => evidence.missing.push(line),
            }
        }
    }
    tells_apart.then_some(found)
}

/// The lines that are compared, by index: those with enough letters, each text once. The same chain beside itself is one
/// sign.
fn signs_of(frame: &[TextLine]) -> Vec<usize> {
    let mut seen = Vec::new();
    let mut signs = Vec::new();
    for (line, text) in frame.iter().enumerate() {
        let folded = Folded::new(&text.text);
        let key = folded.key();
        if folded.chars.len() >= LEAST_LETTERS && !seen.contains(&key) {
            seen.push(key);
            signs.push(line);
        }
    }
    signs
}

/// The signs that a candidate shows, each by the line that matches best.
fn shown_in(frame: &[TextLine], signs: &[usize], lines: &[TextLine]) -> Vec<Shown> {
    let mut shown = Vec::new();
    for (sign, &line) in signs.iter().enumerate() {
        let of_frame = &frame[line];
        let Some(query) = TextQuery::new(&of_frame.text) else { continue };
        let whole = query.matches(lines).filter(|found| found.score >= LEAST_SCORE);
        let whole = whole.and_then(|found| {
            let share = f64::from(2.0 * found.score - 1.0);
            Some((share * share, lines.get(*found.lines.first()?)?))
        });
        let cut = lines.iter().map(|line| (cut_sign(of_frame, line), line));
        let sized = |(worth, line)| (worth * alike_in_size(of_frame, line), line);
        let best = whole.into_iter().chain(cut).map(sized).max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((worth, of_candidate)) = best.filter(|(worth, _)| *worth > 0.0) {
            shown.push(Shown { sign, worth, x: [of_frame, of_candidate].map(middle) });
        }
    }
    shown
}

/// Where a line is from left to right, as a share of the width.
fn middle(line: &TextLine) -> f32 {
    line.corners.iter().map(|corner| corner[0]).sum::<f32>() / 4.0
}

/// The signs that are in the same order from left to right in both pictures: of all such choices, that of the greatest
/// worth. What is out of order is another sign of the same name.
fn in_order(mut shown: Vec<Shown>) -> Vec<Shown> {
    shown.sort_by(|a, b| a.x[0].total_cmp(&b.x[0]));
    // The worth of the best choice that ends with each sign, and the sign before it.
    let mut best: Vec<(f64, Option<usize>)> = Vec::with_capacity(shown.len());
    for (at, one) in shown.iter().enumerate() {
        let before = (0..at).filter(|&before| shown[before].x[1] <= one.x[1]);
        let before = before.max_by(|&a, &b| best[a].0.total_cmp(&best[b].0));
        best.push((one.worth + before.map_or(0.0, |before| best[before].0), before));
    }
    let mut next = (0..best.len()).max_by(|&a, &b| best[a].0.total_cmp(&best[b].0));
    let mut chosen = Vec::new();
    while let Some(at) = next {
        chosen.push(shown[at]);
        next = best[at].1;
    }
    chosen
}

/// How well two lines may be of one sign by their heights, from 0 to 1.
fn alike_in_size(one: &TextLine, other: &TextLine) -> f64 {
    let [one, other] = [one, other].map(|line| {
        let [top_left, top_right, bottom_right, bottom_left] = line.corners.map(|corner| corner[1]);
        f64::from((bottom_left - top_left).max(bottom_right - top_right).max(1e-3))
    });
    (-(one / other).ln().powi(2) / (2.0 * SIZES * SIZES)).exp()
}

/// How much of a line of the frame a line is that an edge of the candidate cuts off, from 0 to 1: RACKER of NUTCRACKER. The
/// letter at the edge is often read as another.
fn cut_sign(of_frame: &TextLine, line: &TextLine) -> f64 {
    let [left, right] = [f32::min, f32::max]
        .map(|choose| line.corners.iter().map(|corner| corner[0]).reduce(choose).unwrap_or(0.5));
    let Folded { chars: part, .. } = Folded::new(&line.text);
    let whole = Folded::new(&of_frame.text).chars;
    let part = match (left < EDGE, right > 1.0 - EDGE) {
        (true, false) => part.get(1..),
        (false, true) => part.len().checked_sub(1).and_then(|end| part.get(..end)),
        _ => None,
    };
    match part.filter(|part| (LEAST_LETTERS..=whole.len()).contains(&part.len())) {
        Some(part) if whole.windows(part.len()).any(|window| window == part) => {
            part.len() as f64 / whole.len() as f64
        }
        _ => 0.0,
    }
}

/// Orders candidates by votes and signs, given their order by votes alone and their share of the votes. Indices of
/// `shares`; equals keep their order.
pub fn order(by_votes: &[usize], shares: &[f32], signs: &[SignEvidence]) -> Vec<usize> {
    let worth = |at: usize| {
        let share = f64::from(shares[at].max(0.0)).max(LEAST_VOTES);
        VOTES * share.ln() + signs[at].log_ratio
    };
    let mut order = by_votes.to_vec();
    order.sort_by(|&a, &b| worth(b).total_cmp(&worth(a)));
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line with the left and right end and the height given as shares of the picture.
    fn line(text: &str, (left, right): (f32, f32), height: f32) -> TextLine {
        let (top, bottom) = (0.4, 0.4 + height);
        TextLine {
            text: text.into(),
            confidence: 0.9,
            corners: [[left, top], [right, top], [right, bottom], [left, bottom]],
        }
    }

    fn sign(text: &str, middle: f32) -> TextLine {
        line(text, (middle - 0.08, middle + 0.08), 0.05)
    }

    fn ratios(frame: &[TextLine], candidates: &[&[TextLine]]) -> Vec<f64> {
        let candidates: Vec<_> = candidates.iter().map(|lines| Some(lines.to_vec())).collect();
        let found = evidence(frame, &candidates).unwrap();
        found.into_iter().map(|evidence| evidence.log_ratio).collect()
    }

    #[test]
    fn a_rare_sign_counts_more_than_one_that_many_candidates_show() {
        let frame = [sign("KAWA COFFEE", 0.3), sign("CITY BANK", 0.7)];
        let (kawa, bank) = ([sign("Kawa Coffee", 0.3)], [sign("CITY BANK", 0.7)]);
        let found = ratios(&frame, &[&bank, &kawa, &bank, &bank, &[]]);
        assert!(found[1] > found[0] && found[0] > found[4], "{found:?}");
        assert!(found[4] < 0.0, "{found:?}");
    }

    #[test]
    fn what_does_not_tell_the_candidates_apart_is_no_evidence() {
        let bank = [sign("CITY BANK", 0.7)];
        let all_or_none =
            |frame: &[TextLine]| evidence(frame, &[Some(bank.to_vec()), Some(bank.to_vec())]);
        assert_eq!(all_or_none(&bank), None, "all show it");
        assert_eq!(all_or_none(&[sign("ZENITH", 0.5)]), None, "none shows it");
        assert_eq!(all_or_none(&[sign("A", 0.5), sign("-", 0.2)]), None, "too short");
        assert_eq!(all_or_none(&[]), None);
        assert_eq!(evidence(&bank, &[]), None);
    }

    #[test]
    fn a_candidate_that_was_not_read_is_neither_better_nor_worse() {
        let bank = sign("CITY BANK", 0.5);
        let candidates = [None, Some(vec![bank.clone()]), Some(vec![])];
        let found = evidence(&[bank], &candidates).unwrap();
        assert_eq!(found[0], SignEvidence::default());
        assert!(found[1].log_ratio > 0.0 && found[2].log_ratio < 0.0, "{found:?}");
        assert_eq!((found[1].shared.as_slice(), found[2].missing.as_slice()), (&[0][..], &[0][..]));
    }

    #[test]
    fn a_sign_that_the_edge_cuts_off_is_recognised_by_its_part() {
        let frame = [sign("NUTCRACKER", 0.4)];
        let cut = line("IRACKER", (0.0, 0.2), 0.05);
        let whole = line("IRACKER", (0.3, 0.5), 0.05);
        let found = ratios(&frame, &[&[cut], &[whole], &[line("RA", (0.0, 0.1), 0.05)]]);
        assert!(found[0] > 0.0 && found[1] < 0.0 && found[2] < 0.0, "{found:?}");
    }

    #[test]
    fn the_same_name_far_away_or_in_another_order_counts_for_less() {
        let frame = [sign("REDWOOD", 0.3), sign("YARROW", 0.7)];
        let same = [sign("REDWOOD", 0.4), sign("YARROW", 0.8)];
        let swapped = [sign("YARROW", 0.3), sign("REDWOOD", 0.7)];
        let far = [line("REDWOOD", (0.1, 0.13), 0.01), line("YARROW", (0.2, 0.23), 0.01)];
        let found = ratios(&frame, &[&same, &swapped, &far, &[]]);
        assert!(found[0] > found[1] && found[0] > found[2] && found[1] > found[3], "{found:?}");
    }

    #[test]
    fn the_order_is_that_of_the_votes_unless_the_signs_say_more() {
        let says = |log_ratio| SignEvidence { log_ratio, ..SignEvidence::default() };
        let by_votes = [1, 0, 2];
        assert_eq!(
            order(&by_votes, &[0.3, 0.31, 0.3], &[says(0.0), says(0.0), says(0.0)]),
            [1, 0, 2]
        );
        // Equal shop fronts: the sign decides.
        assert_eq!(
            order(&by_votes, &[0.3, 0.31, 0.3], &[says(-0.7), says(-0.7), says(2.0)]),
            [2, 1, 0]
        );
        // Other buildings: it does not.
        assert_eq!(
            order(&by_votes, &[0.02, 0.6, 0.02], &[says(-0.7), says(-0.7), says(2.0)])[0],
            1
        );
        assert_eq!(order(&[0, 1], &[f32::NAN, 0.0], &[says(0.0), says(0.0)]), [0, 1]);
    }

    #[test]
    fn a_description_names_the_signs_and_where_they_are() {
        let frame = [sign("KAWA", 0.1), sign("BANK", 0.5), sign("TOYS", 0.9), sign("CLUB", 0.9)];
        let says = |shared: &[usize], missing: &[usize]| {
            let (shared, missing) = (shared.to_vec(), missing.to_vec());
            crate::local::describe_signs(&frame, &SignEvidence { log_ratio: 0.0, shared, missing })
        };
        assert_eq!(says(&[0], &[]), " Both show the sign \u{2018}KAWA\u{2019} (left).");
        assert_eq!(
            says(&[0, 1], &[2, 3]),
            " Both show the signs \u{2018}KAWA\u{2019} (left) and \u{2018}BANK\u{2019} (centre). The frame's \
             \u{2018}TOYS\u{2019} (right) and \u{2018}CLUB\u{2019} (right) are missing from the candidate."
        );
        assert_eq!(
            says(&[], &[1]),
            " The frame's \u{2018}BANK\u{2019} (centre) is missing from the candidate."
        );
        assert_eq!(says(&[], &[]), "");
        // Of many, three are named.
        assert_eq!(says(&[0, 1, 2, 3], &[]).matches('\u{2018}').count(), 3);
    }
}
