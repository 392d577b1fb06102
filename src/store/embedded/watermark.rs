//! The commit watermark: the number of the last commit, stored outside the database as well.
//!
//! When sled finds a damaged page in its log, it takes that for the end of the log and silently drops
//! what follows. That is right after a power cut, where the torn end was never acknowledged, and
//! silent data loss everywhere else. So commits are numbered: the number is written to the database
//! with every commit, and to `DATA/commits` afterwards. A database whose number is lower than the one
//! in that file has lost acknowledged changes.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::super::StoreError;
use super::trees::Trees;

/// The number of the last commit, and the file it is written to.
pub(super) struct CommitWatermark {
    path: PathBuf,
    file: File,
    number: u64,
}

impl CommitWatermark {
    /// Compares the database with the file.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the database is behind the file.
    pub fn open(dir: &Path, trees: &Trees) -> Result<Self, StoreError> {
        let number = trees.commit_number()?;
        if let Some(loss) = detect_loss(dir, trees)? {
            return Err(StoreError::Damaged(loss));
        }
        let path = dir.join("commits");
        let file = File::options().create(true).truncate(false).write(true).open(&path);
        let file = file.map_err(|error| cannot_use(&path, &error))?;
        Ok(Self { path, file, number })
    }

    /// Writes the next number to the database, as part of the commit that is about to be flushed.
    pub fn next(&mut self, trees: &Trees) -> Result<(), StoreError> {
        self.number += 1;
        trees.set_commit_number(self.number)
    }

    /// Writes the number to the file once the commit is durable. The file is not synced: a number that
    /// is too low only detects less.
    pub fn record(&mut self) {
        let text = format!("{:020}\n", self.number);
        let written =
            self.file.seek(SeekFrom::Start(0)).and_then(|_| self.file.write_all(text.as_bytes()));
        if let Err(error) = written {
            tracing::warn!(file = %self.path.display(), %error, "cannot write the commit number");
        }
    }
}

/// Describes what a database has lost, if it has lost anything.
pub(super) fn detect_loss(dir: &Path, trees: &Trees) -> Result<Option<String>, StoreError> {
    let path = dir.join("commits");
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(cannot_use(&path, &error)),
    };
    // A file that was only partly written proves nothing.
    let recorded = text.trim().parse().unwrap_or(0);
    let number = trees.commit_number()?;
    Ok((number < recorded).then(|| {
        format!(
            "{} has lost acknowledged changes: it ends at commit {number} of {recorded}, so its files \
             are damaged. Restore a backup into another folder, or remove {} to continue with what is \
             left",
            dir.join("db").display(),
            path.display()
        )
    }))
}

fn cannot_use(path: &Path, error: &io::Error) -> StoreError {
    StoreError::Failed(format!("cannot use {}: {error}", path.display()))
}
