//! The references, the queries, and the correct references of each query.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use super::resample::sample;
use super::{PictureFile, TruthSource, pictures};
use whereabouts_core::ImageId;

/// The folders of a data set.
#[derive(Debug, Clone)]
pub struct Folders {
    /// References.
    pub database: PathBuf,
    /// Queries.
    pub queries: PathBuf,
    /// Queries from places that are not in the map.
    pub unknown: Option<PathBuf>,
    /// Fraction of the references to leave out, 0 to 1, the last by name. Queries whose correct references are
    /// all left out count as unknown places.
    pub hold_out: f64,
}

/// Which of the queries are evaluated.
#[derive(Debug, Clone, Copy)]
pub struct Sampling {
    /// Number of queries to draw; all if `None`.
    pub size: Option<usize>,
    /// Seed of the random sample.
    pub seed: u64,
}

/// Whether a query has a correct reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QueryKind {
    /// The query has a correct reference and counts in the recall.
    InMap,
    /// The ground truth has no correct reference; the query is left out of the recall.
    Skipped,
    /// The place is not in the map: the query is from the folder of unknown places, or its references are held
    /// out.
    Unknown,
}

/// A query with its ground truth.
#[derive(Debug, Clone)]
pub struct EvaluatedQuery {
    /// The image. The id of an unknown place begins with `unknown:`.
    pub picture: PictureFile,
    /// Whether it has a correct reference.
    pub kind: QueryKind,
    /// Its correct references; empty unless the kind is [`QueryKind::InMap`].
    pub truth: HashSet<ImageId>,
}

/// References and queries.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// The references, sorted by name.
    pub references: Vec<PictureFile>,
    /// The queries to evaluate, sorted by name, those of the folder of unknown places last.
    pub queries: Vec<EvaluatedQuery>,
}

impl Dataset {
    /// Reads the folders and the ground truth.
    ///
    /// # Errors
    /// A folder or the ground truth cannot be read, or no query has a correct reference.
    pub fn read(
        folders: &Folders,
        source: &TruthSource,
        sampling: Sampling,
    ) -> anyhow::Result<Self> {
        let mut references = pictures(&folders.database)?;
        let all = pictures(&folders.queries)?;
        let truth =
            source.read((&folders.database, &references), (&folders.queries, all.as_slice()))?;
        let kept = (references.len() as f64 * (1.0 - folders.hold_out)).round() as usize;
        let held_out: HashSet<ImageId> =
            references.drain(kept.min(references.len())..).map(|picture| picture.id).collect();
        let size = sampling.size.unwrap_or(all.len());
        let sampled: HashSet<usize> = sample(all.len(), size, sampling.seed).into_iter().collect();
        let mut queries: Vec<EvaluatedQuery> = all
            .into_iter()
            .zip(truth)
            .enumerate()
            .filter(|(index, _)| sampled.contains(index))
            .map(|(_, (picture, mut truth))| {
                let had_truth = !truth.is_empty();
                truth.retain(|reference| !held_out.contains(reference));
                let kind = match (truth.is_empty(), had_truth) {
                    (false, _) => QueryKind::InMap,
                    (true, true) => QueryKind::Unknown,
                    (true, false) => QueryKind::Skipped,
                };
                EvaluatedQuery { picture, kind, truth }
            })
            .collect();
        if let Some(folder) = &folders.unknown {
            queries.extend(unknown_places(folder)?);
        }
        if !queries.iter().any(|query| query.kind == QueryKind::InMap) {
            anyhow::bail!(
                "none of the {} queries has a correct reference ({}); raise the threshold or the tolerance, or \
                 check that both folders show the same place",
                queries.len(),
                source.criterion()
            );
        }
        Ok(Self { references, queries })
    }

    /// Counts the queries of a kind.
    pub fn count(&self, kind: QueryKind) -> usize {
        self.queries.iter().filter(|query| query.kind == kind).count()
    }
}

fn unknown_places(folder: &Path) -> anyhow::Result<Vec<EvaluatedQuery>> {
    let kind = QueryKind::Unknown;
    pictures(folder)?
        .into_iter()
        .map(|PictureFile { file, id }| {
            let picture = PictureFile { file, id: format!("unknown:{id}").parse()? };
            Ok(EvaluatedQuery { picture, kind, truth: HashSet::new() })
        })
        .collect()
}
