//! The sizes of the parts of a data folder.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde::Serialize;
use walkdir::WalkDir;

use super::Report;
use crate::StoreError;

/// Free space below which a problem is reported, because a start may need to copy the database.
const LOW_FREE_BYTES: u64 = 1 << 30;

/// Bytes on disk by part. Sparse files count as the space they occupy.
#[derive(Debug, Default, Clone, Copy, Serialize)]
pub struct Sizes {
    /// Records: maps, images, jobs, descriptions.
    pub db: u64,
    /// Descriptors.
    pub descriptors: u64,
    /// Graphs over the descriptors.
    pub graphs: u64,
    /// Pictures of maps and frames of jobs.
    pub images: u64,
    /// Copies made before a migration to a newer version.
    pub copies: u64,
    /// Everything else.
    pub other: u64,
    /// Free space on the disk.
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

    /// Returns the sum of all parts.
    pub fn total(&self) -> u64 {
        self.db + self.descriptors + self.graphs + self.images + self.copies + self.other
    }
}

pub(super) fn check(report: &mut Report) {
    let Sizes { copies, free, .. } = report.sizes;
    if copies > 0 {
        report.note(
            format!(
                "before-version-N holds {:.1} MB of copies made before a migration",
                copies as f64 / 1e6
            ),
            "delete it once the server is known to work",
        );
    }
    if free < LOW_FREE_BYTES {
        report.problem(
            format!("only {:.0} MB are free on the disk", free as f64 / 1e6),
            "free some space: requests that need more are refused with 507",
        );
    }
}
