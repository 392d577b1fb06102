//! What is in a data folder that no server uses, and whether it is in order.

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
use super::{check_folder, compact, lock, mark, schema};
use whereabouts_core::{Digest, ImageId};

const CACHE_BYTES: u64 = 64 << 20;
/// As many of a kind are named in a finding.
const NAMED: usize = 5;

/// How to look at a folder.
#[derive(Debug, Clone, Copy, Default)]
pub struct Examination {
    /// Read every picture and compare its digest.
    pub deep: bool,
    /// Put right what can be without losing anything.
    pub repair: bool,
}

/// What was found.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The folder.
    pub folder: PathBuf,
    /// Its version; null if it is empty.
    pub version: Option<u32>,
    /// What is wrong, or worth knowing.
    pub findings: Vec<Finding>,
    /// Bytes by part.
    pub sizes: Sizes,
    /// The maps, by name.
    pub maps: Vec<MapReport>,
    /// Jobs by state.
    pub jobs: BTreeMap<String, usize>,
}

/// Something that was found.
#[derive(Debug, Clone, Serialize)]
pub struct Finding {
    /// Whether something is lost or will fail.
    pub is_problem: bool,
    /// What it is.
    pub what: String,
    /// What to do about it.
    pub advice: String,
    /// Whether it was put right.
    pub repaired: bool,
}

impl Report {
    /// What is wrong and was not put right.
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

/// Who needs which bytes, as the records of images and jobs say.
#[derive(Default)]
struct Needed {
    /// Bytes of images, each with one that has them.
    images: HashMap<Digest, (String, ImageId)>,
    /// Bytes of frames.
    frames: HashMap<Digest, Uuid>,
    /// The references that there should be.
    references: HashSet<Vec<u8>>,
}

/// The folder, its database, and what is found in them.
struct Doctor<'a> {
    dir: &'a Path,
    trees: Trees,
    how: Examination,
    report: Report,
    needed: Needed,
}

/// Looks at a data folder; [`StoreError::Conflict`] while a server uses it.
pub fn examine(dir: &Path, how: Examination) -> Result<Report, StoreError> {
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
    sizes::look(&mut report);
    match report.version {
        None => {
            report.note("the folder is empty", "`whereabouts serve` fills it");
            return Ok(report);
        }
        Some(version) if version > schema::newest() => {
            let (what, newest) =
                (schema::too_new(dir, version, schema::newest()), schema::newest());
            report.problem(
                what,
                format!("a whereabouts that knows version {newest} cannot look into it"),
            );
            return Ok(report);
        }
        Some(version) if version < schema::newest() => {
            report.note(
                format!(
                    "the folder is of version {version}, and the newest is {}",
                    schema::newest()
                ),
                "the next start of the server copies its records and brings them up to date; then \
                 look again",
            );
            return Ok(report);
        }
        Some(_) => {}
    }
    compact::settle(dir)?;
    let trees = match Trees::open(&dir.join("db"), CACHE_BYTES) {
        Ok(trees) => trees,
        Err(error) => {
            report.problem(
                format!("the database cannot be opened: {error}"),
                "make a new folder and `whereabouts restore` a backup into it; keep this one until \
                 that is done, its pictures are in images/",
            );
            return Ok(report);
        }
    };
    if let Some(lost) = mark::lost(dir, &trees)? {
        // Nothing is repaired: pictures that no record needs may be those whose records are lost.
        report.problem(lost, "look at the disk, too: files do not change by themselves");
        return Ok(report);
    }
    let mut doctor = Doctor { dir, trees, how, report, needed: Needed::default() };
    doctor.maps()?;
    doctor.jobs()?;
    doctor.pictures()?;
    doctor.trees.flush()?;
    Ok(doctor.report)
}

/// Names some of many.
fn some<T: std::fmt::Display>(all: &[T]) -> String {
    let named: Vec<String> = all.iter().take(NAMED).map(T::to_string).collect();
    match all.len().saturating_sub(NAMED) {
        0 => named.join(", "),
        more => format!("{} and {more} more", named.join(", ")),
    }
}
