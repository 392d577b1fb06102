//! How far the record database has come, noted beside it.
//!
//! sled takes a damaged place in its log for the end of it, and goes on with what is before. That is
//! right for the torn end of a power cut, where nothing was acknowledged, and silent loss everywhere
//! else. So commits are numbered: the number goes into the database with every commit, and into
//! `DATA/commits` afterwards. A database that is behind that file has lost what was acknowledged.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::super::StoreError;
use super::trees::Trees;

/// The number of the last commit.
pub(super) struct CommitWatermark {
    path: PathBuf,
    file: File,
    number: u64,
}

impl CommitWatermark {
    /// Holds the database against the file.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the database is behind.
    pub fn open(dir: &Path, trees: &Trees) -> Result<Self, StoreError> {
        let number = trees.commit_number()?;
        if let Some(lost) = lost(dir, trees)? {
            return Err(StoreError::Damaged(lost));
        }
        let path = dir.join("commits");
        let file = File::options().create(true).truncate(false).write(true).open(&path);
        let file = file.map_err(|error| cannot_use(&path, &error))?;
        Ok(Self { path, file, number })
    }

    /// Numbers the changes that are about to be made durable.
    pub fn next(&mut self, trees: &Trees) -> Result<(), StoreError> {
        self.number += 1;
        trees.set_commit_number(self.number)
    }

    /// Notes that they are. It need not be on disk: a note that is late only sees less.
    pub fn note(&mut self) {
        let text = format!("{:020}\n", self.number);
        let written =
            self.file.seek(SeekFrom::Start(0)).and_then(|_| self.file.write_all(text.as_bytes()));
        if let Err(error) = written {
            tracing::warn!(file = %self.path.display(), %error, "a commit cannot be noted");
        }
    }
}

/// Says what a database has lost, if it has.
pub(super) fn lost(dir: &Path, trees: &Trees) -> Result<Option<String>, StoreError> {
    let path = dir.join("commits");
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(cannot_use(&path, &error)),
    };
    // One that was never written to its end says nothing.
    let noted = text.trim().parse().unwrap_or(0);
    let number = trees.commit_number()?;
    Ok((number < noted).then(|| {
        format!(
            "{} has lost changes that were acknowledged: it ends at commit {number} of {noted}, so its \
             files were damaged. Restore a backup into another folder; or remove {} to go on with what \
             is left",
            dir.join("db").display(),
            path.display()
        )
    }))
}

fn cannot_use(path: &Path, error: &io::Error) -> StoreError {
    StoreError::Failed(format!("cannot use {}: {error}", path.display()))
}
