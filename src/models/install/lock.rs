//! The lock of one process on the installation of a model.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use super::error::InstallError;
use super::{disk, remove_if_there};

/// A locked file, which is removed when the lock is released.
#[derive(Debug)]
pub(super) struct InstallLock {
    path: PathBuf,
    /// Locked until it is closed.
    _file: File,
}

impl InstallLock {
    /// Locks a file, or fails at once if another process has locked it.
    pub(super) fn acquire(name: &str, path: PathBuf) -> Result<Self, InstallError> {
        loop {
            let file = File::create(&path).map_err(disk("write", &path))?;
            match file.try_lock() {
                // Its last holder may have removed the file between the two calls.
                Ok(()) if is_at(&file, &path) => return Ok(Self { path, _file: file }),
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    return Err(InstallError::Locked { name: name.to_owned(), lock: path });
                }
                Err(TryLockError::Error(source)) => {
                    return Err(InstallError::Disk { doing: "lock", path, source });
                }
            }
        }
    }
}

impl Drop for InstallLock {
    fn drop(&mut self) {
        // A file that stays costs nothing: the lock is what counts.
        let _ = remove_if_there(&self.path);
    }
}

/// Whether this file is the one that has the path.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (file.metadata(), path.metadata()) {
        (Ok(ours), Ok(there)) => (ours.dev(), ours.ino()) == (there.dev(), there.ino()),
        _ => false,
    }
}

/// Files that are open cannot be removed.
#[cfg(not(unix))]
fn is_at(_file: &File, _path: &Path) -> bool {
    true
}
