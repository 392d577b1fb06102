//! Positions in an archive, with what was before them.

use std::io;
use std::path::Path;

use sha2::{Digest as _, Sha256};

use super::ArchiveError;
use whereabouts_core::Digest;

/// A position in the archive to which the writer can rewind.
#[derive(Clone, Default)]
pub struct Checkpoint {
    hash: Sha256,
    pub(super) bytes: u64,
    pub(super) entries: u64,
}

impl Checkpoint {
    pub(super) fn new(hash: Sha256, bytes: u64, entries: u64) -> Self {
        Self { hash, bytes, entries }
    }

    /// The SHA-256 and number of all bytes before the checkpoint, and the number of entries.
    pub(super) fn totals(self) -> (Digest, u64, u64) {
        (Digest::from(<[u8; 32]>::from(self.hash.finalize())), self.bytes, self.entries)
    }

    pub(super) fn advance(&mut self, bytes: &[u8]) {
        self.hash.update(bytes);
        self.bytes += bytes.len() as u64;
    }
}

/// Returns the error of an operation on a file.
pub(super) fn disk(what: &str, path: &Path) -> impl FnOnce(io::Error) -> ArchiveError + use<> {
    let what = format!("{what} {}", path.display());
    move |source| ArchiveError::Disk { what, source }
}
