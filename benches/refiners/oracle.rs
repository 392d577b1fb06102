//! A mock of a multimodal LLM that is told the truth, and what it makes of it.
//!
//! It knows each picture by the digest of what the service sends of it. It describes a pair by the numbers of its
//! pictures, and ranks by looking up which of them show the same place. No part of it sees a picture.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use serde_json::json;
use sha2::{Digest, Sha256};
use whereabouts_testkit::mock_mllm::{DescribeCall, ReasonCall, Reply, Script};
use whereabouts_vision::ImageLimits;
use whereabouts_vision::decode::{Needed, decode, encode_jpeg};
use whereabouts_vision::preprocess::shrink_to;

use super::sets::TestSet;

/// The longest edge that the service sends, as in its defaults.
const MAX_EDGE: u32 = 768;

/// The share of common queries from which two references show the same place: those within the tolerance of a set in which
/// each query shows the three references on either side.
const SAME_PLACE: f64 = 0.4;

/// What the model makes of the truth.
#[derive(Clone, Copy, Debug)]
pub enum Habit {
    /// It is always right, and says so; where no candidate is right, it says that.
    Truthful,
    /// In one of five frames it is certain of a wrong candidate, also where none is right.
    ErrsInAFifth,
    /// It is always certain: where no candidate is right, of any.
    OverConfident,
    /// It is always certain of a wrong candidate.
    Liar,
}

impl Habit {
    pub const ALL: [Self; 4] =
        [Self::Truthful, Self::ErrsInAFifth, Self::OverConfident, Self::Liar];

    pub fn name(self) -> &'static str {
        match self {
            Self::Truthful => "oracle",
            Self::ErrsInAFifth => "errs in 20 %",
            Self::OverConfident => "always certain",
            Self::Liar => "liar",
        }
    }
}

/// The pictures of a set by their digests, and which show the same place.
pub struct Truth {
    numbers: HashMap<String, usize>,
    same: HashSet<(usize, usize)>,
}

impl Truth {
    /// Reads the pictures of a set.
    pub fn of(set: &TestSet) -> anyhow::Result<Self> {
        let mut numbers = HashMap::new();
        for (number, file) in set.pictures.iter().enumerate() {
            numbers.insert(sent_digest(&std::fs::read(file)?)?, number);
        }
        // A query shows what it is said to show. Two other pictures show the same place if they are shown by mostly the
        // same queries.
        let mut shown_by: HashMap<usize, HashSet<usize>> = HashMap::new();
        for (place, shown) in set.places.iter().enumerate() {
            for picture in shown {
                shown_by.entry(*picture).or_default().insert(place);
            }
        }
        let mut same = HashSet::new();
        for shown in &set.places {
            let Some((query, references)) = shown.split_first() else { continue };
            for one in references {
                same.extend([(*query, *one), (*one, *query)]);
                same.extend(references.iter().map(|other| (*one, *other)).filter(
                    |(one, other)| {
                        let (one, other) = (&shown_by[one], &shown_by[other]);
                        let common = one.intersection(other).count() as f64;
                        common / one.union(other).count() as f64 >= SAME_PLACE
                    },
                ));
            }
        }
        Ok(Self { numbers, same })
    }

    fn number(&self, digest: &str) -> usize {
        self.numbers.get(digest).copied().unwrap_or(usize::MAX)
    }
}

/// The digest of a picture as the service sends it, as the mock computes it.
fn sent_digest(bytes: &[u8]) -> anyhow::Result<String> {
    let limits = ImageLimits { max_pixels: 50_000_000 };
    let picture = decode(bytes, limits, Needed::LongestEdge(MAX_EDGE))?;
    let jpeg = encode_jpeg(&shrink_to(&picture.pixels, MAX_EDGE)?)?;
    Ok(Sha256::digest(&jpeg).iter().take(8).map(|byte| format!("{byte:02x}")).collect())
}

/// Scripts a mock with this habit.
pub fn script(truth: Arc<Truth>, habit: Habit) -> Script {
    let known = Arc::clone(&truth);
    Script {
        describe: Box::new(move |call: &DescribeCall| {
            let (frame, candidate) = (known.number(&call.pair.0), known.number(&call.pair.1));
            Reply::Text(format!("frame number {frame} and candidate number {candidate} as shown"))
        }),
        reason: Box::new(move |call: &ReasonCall| rank(&truth, habit, call)),
        ..Script::default()
    }
}

fn rank(truth: &Truth, habit: Habit, call: &ReasonCall) -> Reply {
    let pairs: Vec<(&str, usize, usize)> = call
        .notes
        .iter()
        .map(|(label, text)| {
            let mut numbers = text.split(' ').filter_map(|word| word.parse().ok());
            let mut next = || numbers.next().unwrap_or(usize::MAX);
            (label.as_str(), next(), next())
        })
        .collect();
    let is_right = |(_, frame, candidate): &(&str, usize, usize)| {
        frame == candidate || truth.same.contains(&(*frame, *candidate))
    };
    let frame = pairs.first().map_or(0, |(_, frame, _)| *frame);
    let (mut right, mut wrong): (Vec<_>, Vec<_>) =
        pairs.iter().copied().partition(|pair| is_right(pair));
    wrong.sort_by_key(|(_, frame, candidate)| dice(&[*frame, *candidate]));
    let lies = match habit {
        Habit::Truthful | Habit::OverConfident => false,
        Habit::ErrsInAFifth => dice(&[frame]).is_multiple_of(5),
        Habit::Liar => true,
    };
    let certainty = match (habit, right.is_empty(), lies) {
        (Habit::OverConfident, ..) | (_, _, true) | (_, false, false) => "certain",
        (_, true, false) => "none",
    };
    if lies {
        std::mem::swap(&mut right, &mut wrong);
    }
    let labels: Vec<&str> = right.iter().chain(&wrong).map(|(label, ..)| *label).collect();
    let answer = json!({"reasoning": "as known", "ranking": labels, "certainty": certainty});
    Reply::Text(answer.to_string())
}

/// A number that is random and always the same.
fn dice(of: &[usize]) -> u64 {
    let digest = Sha256::digest(format!("{of:?}").as_bytes());
    digest.iter().take(8).fold(0, |number, byte| number << 8 | u64::from(*byte))
}
