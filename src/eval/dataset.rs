//! The references, the queries, and the correct references of each query.

use std::collections::HashSet;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::account::{bounded, skipped_lines, warning_lines};
use super::resample::sample;
use super::{Folder, PictureFile, RowAccount, SkippedFile, TruthSource};
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

/// What of the folders is not evaluated, and why. Every picture that is not in the data set is here once.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct LeftOut {
    /// Files that cannot be taken.
    pub skipped: Vec<SkippedFile>,
    /// References without a position: it is not known for which queries they are correct.
    pub references: Vec<ImageId>,
    /// Queries without a position; they count as skipped.
    pub queries: Vec<ImageId>,
    /// What became of the rows of the tables of positions.
    pub tables: Vec<RowAccount>,
    /// Images with the warnings about their positions.
    pub warnings: Vec<(ImageId, String)>,
}

/// References and queries.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// The references, in the natural order of their names.
    pub references: Vec<PictureFile>,
    /// The queries to evaluate, in the natural order of their names, those of the folder of unknown places last.
    pub queries: Vec<EvaluatedQuery>,
    /// What is not evaluated.
    pub left_out: LeftOut,
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
        let (database, all) = (Folder::read(&folders.database)?, Folder::read(&folders.queries)?);
        let truth = source.read(&database, &all)?;
        let mut left_out = LeftOut {
            skipped: [&database.skipped[..], &all.skipped].concat(),
            tables: truth.tables,
            warnings: truth.warnings,
            ..LeftOut::default()
        };
        let (mut references, unknown): (Vec<PictureFile>, Vec<PictureFile>) = database
            .pictures
            .into_iter()
            .partition(|picture| !truth.unknown_references.contains(&picture.id));
        left_out.references = unknown.into_iter().map(|picture| picture.id).collect();
        let (mut known, mut correct) = (Vec::new(), Vec::new());
        for (picture, truth) in all.pictures.into_iter().zip(truth.correct) {
            match truth {
                Some(truth) => {
                    known.push(picture);
                    correct.push(truth);
                }
                None => left_out.queries.push(picture.id),
            }
        }
        let all = known;
        let kept = (references.len() as f64 * (1.0 - folders.hold_out)).round() as usize;
        let held_out: HashSet<ImageId> =
            references.drain(kept.min(references.len())..).map(|picture| picture.id).collect();
        let size = sampling.size.unwrap_or(all.len());
        let sampled: HashSet<usize> = sample(all.len(), size, sampling.seed).into_iter().collect();
        let mut queries: Vec<EvaluatedQuery> = all
            .into_iter()
            .zip(correct)
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
            let unknown = Folder::read(folder)?;
            left_out.skipped.extend(unknown.skipped);
            queries.extend(unknown_places(unknown.pictures)?);
        }
        if !queries.iter().any(|query| query.kind == QueryKind::InMap) {
            anyhow::bail!(
                "none of the {} queries has a correct reference ({}); raise the threshold or the tolerance, or \
                 check that both folders show the same place",
                queries.len(),
                source.criterion()
            );
        }
        Ok(Self { references, queries, left_out })
    }

    /// Counts the queries of a kind.
    pub fn count(&self, kind: QueryKind) -> usize {
        self.queries.iter().filter(|query| query.kind == kind).count()
    }
}

impl LeftOut {
    /// What is left out in lines for people, each list bounded to `most` names.
    pub fn lines(&self, most: usize) -> Vec<String> {
        let mut lines = skipped_lines(&self.skipped, most);
        let list = |ids: &[ImageId]| bounded(ids, most, ImageId::to_string);
        for (what, ids) in [("references", &self.references), ("queries", &self.queries)] {
            if !ids.is_empty() {
                lines.push(format!(
                    "{what} left out, without a position ({}): {}",
                    ids.len(),
                    list(ids)
                ));
            }
        }
        lines.extend(self.tables.iter().flat_map(|table| table.lines(most)));
        lines.extend(warning_lines(&self.warnings, most));
        lines
    }
}

fn unknown_places(pictures: Vec<PictureFile>) -> anyhow::Result<Vec<EvaluatedQuery>> {
    let kind = QueryKind::Unknown;
    pictures
        .into_iter()
        .map(|PictureFile { file, id }| {
            let picture = PictureFile { file, id: format!("unknown:{id}").parse()? };
            Ok(EvaluatedQuery { picture, kind, truth: HashSet::new() })
        })
        .collect()
}
