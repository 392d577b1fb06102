//! What is evaluated: references, queries, and which references are true for which query.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use super::resample::sample;
use super::{PictureFile, TruthSource, pictures};
use whereabouts_core::ImageId;

/// Where the pictures are.
#[derive(Debug, Clone)]
pub struct Folders {
    /// References.
    pub database: PathBuf,
    /// Queries.
    pub queries: PathBuf,
    /// Queries from places that are not in the map, if there are any.
    pub unknown: Option<PathBuf>,
    /// The share of the references that is left out, the last by name, 0 to 1. Queries of which no true
    /// reference is left are from places that are not in the map.
    pub hold_out: f64,
}

/// Which of the queries are evaluated.
#[derive(Debug, Clone, Copy)]
pub struct Sampling {
    /// How many; all if `None`.
    pub size: Option<usize>,
    /// Decides which.
    pub seed: u64,
}

/// What a query can show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QueryKind {
    /// A place of which there is a true reference; it counts in the recall.
    InMap,
    /// No true reference is known; it is left out of the recall.
    Skipped,
    /// A place that is not in the map: from the folder of unknown places, or held out.
    Unknown,
}

/// A query that is asked.
#[derive(Debug, Clone)]
pub struct EvaluatedQuery {
    /// The picture. The id of an unknown place begins with `unknown:`.
    pub picture: PictureFile,
    /// What it can show.
    pub kind: QueryKind,
    /// Its true references; none unless it is in the map.
    pub truth: HashSet<ImageId>,
}

/// References and queries.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// The references, by name.
    pub references: Vec<PictureFile>,
    /// The queries that are asked, by name; those of unknown places last.
    pub queries: Vec<EvaluatedQuery>,
}

impl Dataset {
    /// Reads the folders and the ground truth.
    pub fn read(
        folders: &Folders,
        source: &TruthSource,
        sampling: Sampling,
    ) -> anyhow::Result<Self> {
        let mut references = pictures(&folders.database)?;
        let all = pictures(&folders.queries)?;
        let truth =
            source.read((&folders.database, &references), (&folders.queries, all.as_slice()))?;
        let left = (references.len() as f64 * (1.0 - folders.hold_out)).round() as usize;
        let held_out: HashSet<ImageId> =
            references.drain(left.min(references.len())..).map(|picture| picture.id).collect();
        let size = sampling.size.unwrap_or(all.len());
        let chosen: HashSet<usize> = sample(all.len(), size, sampling.seed).into_iter().collect();
        let mut queries: Vec<EvaluatedQuery> = all
            .into_iter()
            .zip(truth)
            .enumerate()
            .filter(|(place, _)| chosen.contains(place))
            .map(|(_, (picture, mut truth))| {
                let had = !truth.is_empty();
                truth.retain(|reference| !held_out.contains(reference));
                let kind = match (truth.is_empty(), had) {
                    (false, _) => QueryKind::InMap,
                    (true, true) => QueryKind::Unknown,
                    (true, false) => QueryKind::Skipped,
                };
                EvaluatedQuery { picture, kind, truth }
            })
            .collect();
        if let Some(folder) = &folders.unknown {
            queries.extend(unknown(folder)?);
        }
        if !queries.iter().any(|query| query.kind == QueryKind::InMap) {
            anyhow::bail!(
                "none of the {} queries has a true reference ({}); raise the threshold or the \
                 tolerance, or check that both folders are of the same place",
                queries.len(),
                source.said()
            );
        }
        Ok(Self { references, queries })
    }

    /// How many queries are of this kind.
    pub fn count(&self, kind: QueryKind) -> usize {
        self.queries.iter().filter(|query| query.kind == kind).count()
    }
}

fn unknown(folder: &Path) -> anyhow::Result<Vec<EvaluatedQuery>> {
    let kind = QueryKind::Unknown;
    pictures(folder)?
        .into_iter()
        .map(|PictureFile { file, id }| {
            let picture = PictureFile { file, id: format!("unknown:{id}").parse()? };
            Ok(EvaluatedQuery { picture, kind, truth: HashSet::new() })
        })
        .collect()
}
