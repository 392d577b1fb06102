//! Checks the consistency of a data folder that no server uses.

mod jobs;
mod maps;
mod pictures;
mod sizes;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};

use serde::Serialize;
use uuid::Uuid;

pub use self::maps::MapReport;
pub use self::sizes::Sizes;
use super::super::StoreError;
use super::trees::Trees;
use super::{check_folder, compact, lock, schema, watermark};
use whereabouts_core::{Digest, ImageId};

const CACHE_BYTES: u64 = 64 << 20;
/// Number of affected items that a finding lists by name.
const MAX_LISTED: usize = 5;

/// Options of an examination.
#[derive(Debug, Clone, Copy, Default)]
pub struct Examination {
    /// Reads every picture and compares its digest.
    pub deep: bool,
    /// Repairs what can be repaired without losing data.
    pub repair: bool,
}

/// The result of an examination.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The data folder.
    pub folder: PathBuf,
    /// The version of the folder; null if it is empty.
    pub version: Option<u32>,
    /// Problems and notes.
    pub findings: Vec<Finding>,
    /// Sizes of its parts.
    pub sizes: Sizes,
    /// The maps, sorted by name.
    pub maps: Vec<MapReport>,
    /// Number of jobs by state.
    pub jobs: BTreeMap<String, usize>,
}

/// A problem or a note.
#[derive(Debug, Clone, Serialize)]
pub struct Finding {
    /// Whether data is lost or something will fail.
    pub is_problem: bool,
    /// What was found.
    pub what: String,
    /// What to do about it.
    pub advice: String,
    /// Whether it was repaired.
    pub repaired: bool,
}

impl Report {
    /// Returns the number of problems that were not repaired.
    pub fn problems(&self) -> usize {
        self.findings.iter().filter(|finding| finding.is_problem && !finding.repaired).count()
    }

    fn problem(&mut self, what: impl Into<String>, advice: impl Into<String>) {
        self.found(true, what, advice, false);
    }

    fn note(&mut self, what: impl Into<String>, advice: impl Into<String>) {
        self.found(false, what, advice, false);
    }

    fn found(
        &mut self,
        is_problem: bool,
        what: impl Into<String>,
        advice: impl Into<String>,
        repaired: bool,
    ) {
        let (what, advice) = (what.into(), advice.into());
        self.findings.push(Finding { is_problem, what, advice, repaired });
    }
}

/// The blobs and references that the records of images and jobs require.
#[derive(Default)]
struct Required {
    /// Blobs of images, each with the map and id of one such image.
    images: HashMap<Digest, (String, ImageId)>,
    /// Blobs of frames, each with the id of one such job.
    frames: HashMap<Digest, Uuid>,
    /// Blobs of maps' own vocabularies, each with its map.
    vocabularies: HashMap<Digest, String>,
    /// Keys in `blob_refs`.
    references: HashSet<Vec<u8>>,
}

/// An examination in progress.
struct Doctor<'a> {
    dir: &'a Path,
    trees: Trees,
    options: Examination,
    report: Report,
    required: Required,
}

/// Examines a data folder.
///
/// # Errors
/// [`StoreError::Conflict`] while a server uses the folder.
pub fn examine(dir: &Path, options: Examination) -> Result<Report, StoreError> {
    check_folder(dir)?;
    let _lock = lock(dir)?;
    let mut report = Report {
        folder: dir.to_owned(),
        version: schema::version_of(dir)?,
        findings: Vec::new(),
        sizes: Sizes::default(),
        maps: Vec::new(),
        jobs: BTreeMap::new(),
    };
    report.sizes = Sizes::of(dir)?;
    sizes::check(&mut report);
    match report.version {
        None => {
            report.note("the folder is empty", "`whereabouts serve` initializes it");
            return Ok(report);
        }
        Some(version) if version > schema::newest() => {
            let (what, newest) =
                (schema::too_new(dir, version, schema::newest()), schema::newest());
            report.problem(
                what,
                format!("this program supports versions up to {newest} and cannot examine it"),
            );
            return Ok(report);
        }
        Some(version) if version < schema::newest() => {
            report.note(
                format!(
                    "the folder is of version {version}, but the newest version is {}",
                    schema::newest()
                ),
                "the next start of the server copies its records and migrates them; run this command \
                 again afterwards",
            );
            return Ok(report);
        }
        Some(_) => {}
    }
    compact::finish_interrupted(dir)?;
    let trees = match Trees::open(&dir.join("db"), CACHE_BYTES) {
        Ok(trees) => trees,
        Err(error) => {
            report.problem(
                format!("the database cannot be opened: {error}"),
                "`whereabouts restore` a backup into a new folder; keep this one until that is done, \
                 because its pictures are in images/",
            );
            return Ok(report);
        }
    };
    if let Some(loss) = watermark::detect_loss(dir, &trees)? {
        // Repair nothing: pictures without a record may belong to the lost records.
        report.problem(loss, "check the disk as well: files do not change by themselves");
        return Ok(report);
    }
    let mut doctor = Doctor { dir, trees, options, report, required: Required::default() };
    doctor.maps()?;
    doctor.jobs()?;
    doctor.pictures()?;
    doctor.trees.flush()?;
    Ok(doctor.report)
}

/// Lists the first few items and counts the others.
fn list<T: std::fmt::Display>(items: &[T]) -> String {
    let listed: Vec<String> = items.iter().take(MAX_LISTED).map(T::to_string).collect();
    match items.len().saturating_sub(MAX_LISTED) {
        0 => listed.join(", "),
        more => format!("{} and {more} more", listed.join(", ")),
    }
}
