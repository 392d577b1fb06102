//! Which queries a reader is shown, and their pictures.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::super::{Dataset, EvaluatedQuery, MethodOutcomes, Outcome, Prediction, QueryKind};
use whereabouts_core::ImageId;
use whereabouts_vision::{ImageLimits, decode, preprocess};

/// The kinds of the paper's figure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Wrong before refinement, right after.
    Success,
    /// Right before, wrong after.
    Harm,
    /// Wrong before and after.
    CouldNotHelp,
    /// A coarse answer that is wrong, where nothing was refined.
    Wrong,
}

impl Kind {
    /// The heading of its examples.
    pub fn heading(self) -> &'static str {
        match self {
            Self::Success => "Success: refinement put it right",
            Self::Harm => "Harm: refinement spoilt it",
            Self::CouldNotHelp => "Could not help: wrong before and after",
            Self::Wrong => "Wrong first answers",
        }
    }
}

/// Examples of one kind.
pub struct Group<'a> {
    /// The name of the method.
    pub method: String,
    pub kind: Kind,
    /// All queries of the kind.
    pub count: usize,
    /// Those that are shown.
    pub shown: Vec<Example<'a>>,
}

/// One query with what was answered.
pub struct Example<'a> {
    pub query: &'a EvaluatedQuery,
    pub before: &'a Prediction,
    /// After refinement, with what the refiner said.
    pub after: Option<(&'a Prediction, &'a Outcome)>,
}

/// Examples that are shown of each kind and method.
const SHOWN: usize = 4;

/// Chooses examples of every kind for every method: evenly spread over the queries.
pub fn choose<'a>(data: &'a Dataset, found: &'a [MethodOutcomes]) -> Vec<Group<'a>> {
    let mut groups = Vec::new();
    let mut coarse: Option<&MethodOutcomes> = None;
    for (place, method) in found.iter().enumerate() {
        let name = method.method.name();
        if method.method.refiner.is_none() {
            coarse = Some(method);
            // Where it is refined, the refined method shows the same queries and more.
            if found.get(place + 1).is_none_or(|next| next.method.refiner.is_none()) {
                groups.push(group(&name, Kind::Wrong, wrong(data, method)));
            }
        } else if let Some(coarse) = coarse {
            for kind in [Kind::Success, Kind::Harm, Kind::CouldNotHelp] {
                groups.push(group(&name, kind, refined(data, coarse, method, kind)));
            }
        }
    }
    groups
}

fn group<'a>(method: &str, kind: Kind, all: Vec<Example<'a>>) -> Group<'a> {
    let count = all.len();
    let shown = count.min(SHOWN);
    let places: Vec<usize> = (0..shown).map(|i| i * count / shown).collect();
    let spread = all.into_iter().enumerate().filter(|(place, _)| places.contains(place));
    Group { method: method.to_owned(), kind, count, shown: spread.map(|(_, one)| one).collect() }
}

fn is_right(query: &EvaluatedQuery, answer: &Prediction) -> bool {
    query.truth.contains(&answer.image_id)
}

fn wrong<'a>(data: &'a Dataset, method: &'a MethodOutcomes) -> Vec<Example<'a>> {
    data.queries
        .iter()
        .zip(&method.outcomes)
        .filter(|(query, _)| query.kind == QueryKind::InMap)
        .filter_map(|(query, outcome)| {
            let before = outcome.answers.first()?;
            (!is_right(query, before)).then_some(Example { query, before, after: None })
        })
        .collect()
}

fn refined<'a>(
    data: &'a Dataset,
    coarse: &'a MethodOutcomes,
    method: &'a MethodOutcomes,
    kind: Kind,
) -> Vec<Example<'a>> {
    data.queries
        .iter()
        .zip(coarse.outcomes.iter().zip(&method.outcomes))
        .filter(|(query, _)| query.kind == QueryKind::InMap)
        .filter_map(|(query, (before, after))| {
            let (first, refined) = (before.answers.first()?, after.answers.first()?);
            let wanted = match kind {
                Kind::Success => (false, true),
                Kind::Harm => (true, false),
                Kind::CouldNotHelp | Kind::Wrong => (false, false),
            };
            ((is_right(query, first), is_right(query, refined)) == wanted).then_some(Example {
                query,
                before: first,
                after: Some((refined, after)),
            })
        })
        .collect()
}

/// Pictures as they are held in the page.
pub struct Pictures<'a> {
    references: HashMap<&'a ImageId, &'a PathBuf>,
    limits: ImageLimits,
}

/// The longest edge of a picture in the page, in pixels.
const MAX_EDGE: u32 = 360;

impl<'a> Pictures<'a> {
    /// Looks nothing up yet.
    pub fn new(data: &'a Dataset, limits: ImageLimits) -> Self {
        let references = data.references.iter().map(|picture| (&picture.id, &picture.file));
        Self { references: references.collect(), limits }
    }

    /// A reference as a data URI.
    pub fn reference(&self, id: &ImageId) -> anyhow::Result<String> {
        let file =
            self.references.get(id).with_context(|| format!("there is no reference {id}"))?;
        self.picture(file)
    }

    /// A picture as a data URI: a JPEG, shrunk.
    pub fn picture(&self, file: &Path) -> anyhow::Result<String> {
        let named = || file.display().to_string();
        let bytes = std::fs::read(file).with_context(named)?;
        let picture = decode::decode(&bytes, self.limits, decode::Needed::LongestEdge(MAX_EDGE))
            .with_context(named)?;
        let small = preprocess::shrink_to(&picture.pixels, MAX_EDGE).with_context(named)?;
        let jpeg = decode::encode_jpeg(&small).with_context(named)?;
        Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
    }
}
