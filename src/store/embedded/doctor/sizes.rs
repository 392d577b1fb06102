//! How large the parts of a data folder are.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde::Serialize;
use walkdir::WalkDir;

use super::Report;
use crate::StoreError;

/// Less room than this is worth a word: a start may need to copy the database.
const LITTLE_ROOM: u64 = 1 << 30;

/// Bytes on disk by part. Files may be sparse: what counts is the room they take.
#[derive(Debug, Default, Clone, Copy, Serialize)]
pub struct Sizes {
    /// Records: maps, images, jobs, descriptions.
    pub db: u64,
    /// Descriptors.
    pub descriptors: u64,
    /// Graphs, which are derived from descriptors.
    pub graphs: u64,
    /// Pictures of maps and frames of jobs.
    pub images: u64,
    /// Copies from before the folder was brought to a newer version.
    pub copies: u64,
    /// All the rest.
    pub other: u64,
    /// Room that is left on the disk.
    pub free: u64,
}

impl Sizes {
    pub(super) fn of(dir: &Path) -> Result<Self, StoreError> {
        let mut sizes = Self::default();
        for entry in WalkDir::new(dir).min_depth(1) {
            let failed = |error: walkdir::Error| StoreError::Failed(error.to_string());
            let entry = entry.map_err(failed)?;
            let bytes = entry.metadata().map_err(failed)?.blocks() * 512;
            let path = entry.path().strip_prefix(dir).unwrap_or(entry.path());
            let part = path.components().next().map(|part| part.as_os_str().to_string_lossy());
            let sum = match part.as_deref() {
                Some("db") => &mut sizes.db,
                Some("descriptors") if path.ends_with("graph") => &mut sizes.graphs,
                Some("descriptors") => &mut sizes.descriptors,
                Some("images") => &mut sizes.images,
                Some(part) if part.starts_with("before-version-") => &mut sizes.copies,
                _ => &mut sizes.other,
            };
            *sum += bytes;
        }
        let free = fs2::available_space(dir);
        sizes.free = free.map_err(|error| StoreError::Failed(error.to_string()))?;
        Ok(sizes)
    }

    /// All parts together.
    pub fn total(&self) -> u64 {
        self.db + self.descriptors + self.graphs + self.images + self.copies + self.other
    }
}

pub(super) fn look(report: &mut Report) {
    let Sizes { copies, free, .. } = report.sizes;
    if copies > 0 {
        report.note(
            format!(
                "before-version-N holds {:.1} MB from before a newer version",
                copies as f64 / 1e6
            ),
            "delete it once the server has been seen to work",
        );
    }
    if free < LITTLE_ROOM {
        report.problem(
            format!("only {:.0} MB are free on the disk", free as f64 / 1e6),
            "make room: what cannot be written is refused with 507",
        );
    }
}
