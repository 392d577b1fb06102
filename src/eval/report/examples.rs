//! Chooses example queries and reads their images.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::super::summary::query_outcomes;
use super::super::{Dataset, EvaluatedQuery, MethodOutcomes, Prediction, QueryKind, QueryOutcome};
use whereabouts_core::ImageId;
use whereabouts_vision::{ImageLimits, decode, preprocess};

/// Kinds of examples, as in the figure of the paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Wrong before refinement, correct after.
    Success,
    /// Correct before, wrong after.
    Harm,
    /// Wrong before and after.
    CouldNotHelp,
    /// Wrong, for a coarse method without a refiner.
    Wrong,
}

impl Kind {
    /// Returns the heading above the examples.
    pub fn heading(self) -> &'static str {
        match self {
            Self::Success => "Success: wrong before refinement, correct after",
            Self::Harm => "Harm: correct before refinement, wrong after",
            Self::CouldNotHelp => "Could not help: wrong before and after refinement",
            Self::Wrong => "Wrong first answers",
        }
    }
}

/// Examples of one kind for one method.
pub struct Group<'a> {
    /// Name of the method.
    pub method: String,
    pub kind: Kind,
    /// Number of all queries of the kind.
    pub count: usize,
    /// The queries that are shown.
    pub shown: Vec<Example<'a>>,
}

/// One query with its first prediction.
pub struct Example<'a> {
    pub query: &'a EvaluatedQuery,
    pub before: &'a Prediction,
    /// The first prediction after refinement, with the outcome that it is from.
    pub after: Option<(&'a Prediction, &'a QueryOutcome)>,
}

/// Number of examples of each kind and method.
const SHOWN: usize = 4;

/// Chooses examples of every kind for every method, evenly spread over the queries.
pub fn choose<'a>(data: &'a Dataset, methods: &'a [MethodOutcomes]) -> Vec<Group<'a>> {
    let mut groups = Vec::new();
    let mut coarse: Option<&MethodOutcomes> = None;
    for (index, method) in methods.iter().enumerate() {
        let name = method.method.name();
        if method.method.refiner.is_none() {
            coarse = Some(method);
            // A refined method shows the same queries and more.
            if methods.get(index + 1).is_none_or(|next| next.method.refiner.is_none()) {
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
    let indices: Vec<usize> = (0..shown).map(|i| i * count / shown).collect();
    let spread = all.into_iter().enumerate().filter(|(index, _)| indices.contains(index));
    Group { method: method.to_owned(), kind, count, shown: spread.map(|(_, one)| one).collect() }
}

fn is_correct(query: &EvaluatedQuery, prediction: &Prediction) -> bool {
    query.truth.contains(&prediction.image_id)
}

fn wrong<'a>(data: &'a Dataset, method: &'a MethodOutcomes) -> Vec<Example<'a>> {
    query_outcomes(data, method)
        .filter(|(query, _)| query.kind == QueryKind::InMap)
        .filter_map(|(query, outcome)| {
            let before = outcome.predictions.first()?;
            (!is_correct(query, before)).then_some(Example { query, before, after: None })
        })
        .collect()
}

fn refined<'a>(
    data: &'a Dataset,
    coarse: &'a MethodOutcomes,
    method: &'a MethodOutcomes,
    kind: Kind,
) -> Vec<Example<'a>> {
    query_outcomes(data, coarse)
        .zip(&method.outcomes)
        .filter(|((query, _), _)| query.kind == QueryKind::InMap)
        .filter_map(|((query, coarse), refined)| {
            let (before, after) = (coarse.predictions.first()?, refined.predictions.first()?);
            let verdicts = match kind {
                Kind::Success => (false, true),
                Kind::Harm => (true, false),
                Kind::CouldNotHelp | Kind::Wrong => (false, false),
            };
            ((is_correct(query, before), is_correct(query, after)) == verdicts).then_some(Example {
                query,
                before,
                after: Some((after, refined)),
            })
        })
        .collect()
}

/// Reads images and encodes them for the page.
pub struct Pictures<'a> {
    references: HashMap<&'a ImageId, &'a PathBuf>,
    limits: ImageLimits,
}

/// Longest edge of an image in the page, in pixels.
const MAX_EDGE: u32 = 360;

impl<'a> Pictures<'a> {
    /// Indexes the references; reads no file yet.
    pub fn new(data: &'a Dataset, limits: ImageLimits) -> Self {
        let references = data.references.iter().map(|picture| (&picture.id, &picture.file));
        Self { references: references.collect(), limits }
    }

    /// Returns a reference as a data URI.
    pub fn reference(&self, id: &ImageId) -> anyhow::Result<String> {
        let file = self
            .references
            .get(id)
            .with_context(|| format!("the data set has no reference {id}"))?;
        self.picture(file)
    }

    /// Returns an image as a data URI: a JPEG, scaled down.
    pub fn picture(&self, file: &Path) -> anyhow::Result<String> {
        let context = || file.display().to_string();
        let bytes = std::fs::read(file).with_context(context)?;
        let picture = decode::decode(&bytes, self.limits, decode::Needed::LongestEdge(MAX_EDGE))
            .with_context(context)?;
        let small = preprocess::shrink_to(&picture.pixels, MAX_EDGE).with_context(context)?;
        let jpeg = decode::encode_jpeg(&small).with_context(context)?;
        Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
    }
}
