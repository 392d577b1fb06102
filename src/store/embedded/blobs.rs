//! Image bytes in a content-addressed folder: `images/ab/cdef…`, named by their SHA-256.
//!
//! `object_store`'s local folder syncs files as durably as this, but only asynchronously; here a file is
//! deleted under the lock of the pins, on the writer thread, so that no new pin can be missed.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use parking_lot::Mutex;

use super::super::StoreError;
use super::create_folder;
use super::trees::Trees;
use whereabouts_core::Digest;

/// The folder of image bytes. Clones share its pins.
#[derive(Clone)]
pub(super) struct Blobs {
    dir: PathBuf,
    /// Disk space reserved for records, so that they can still be written and deleted.
    min_free: u64,
    /// Blobs that no record may refer to yet, each with its number of pins.
    pinned: Arc<Mutex<HashMap<Digest, usize>>>,
}

/// Protects a blob from removal until it is dropped.
pub(super) struct Pin {
    digest: Digest,
    pinned: Arc<Mutex<HashMap<Digest, usize>>>,
}

impl Drop for Pin {
    fn drop(&mut self) {
        let mut pinned = self.pinned.lock();
        if let Some(count) = pinned.get_mut(&self.digest) {
            *count -= 1;
            if *count == 0 {
                pinned.remove(&self.digest);
            }
        }
    }
}

impl Blobs {
    pub fn open(dir: PathBuf, min_free: u64) -> Result<Self, StoreError> {
        create_folder(&dir)?;
        Ok(Self { dir, min_free, pinned: Arc::default() })
    }

    /// Returns the free space of the disk, in bytes.
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        fs2::available_space(&self.dir).map_err(|error| {
            let dir = self.dir.display();
            StoreError::Failed(format!("cannot read the free space of {dir}: {error}"))
        })
    }

    /// Refuses bytes that would exceed the free space. Nearly every change begins with the bytes of a
    /// picture, so this protects the whole data folder.
    fn check_room(&self, bytes: usize) -> Result<(), StoreError> {
        let free = self.free_bytes()?;
        if free < self.min_free.saturating_add(bytes as u64) {
            return Err(StoreError::Full { free, kept: self.min_free });
        }
        Ok(())
    }

    /// Stores bytes durably. They are pinned first, so that a concurrent removal cannot delete them.
    pub fn put(&self, digest: Digest, bytes: &Bytes) -> Result<Pin, StoreError> {
        *self.pinned.lock().entry(digest).or_insert(0) += 1;
        let pin = Pin { digest, pinned: Arc::clone(&self.pinned) };
        let path = self.path(&digest);
        // Files are complete when they are renamed to this name, so the length is proof enough.
        if fs::metadata(&path).is_ok_and(|found| found.len() == bytes.len() as u64) {
            return Ok(pin);
        }
        self.check_room(bytes.len())?;
        write_durably(&path, bytes).map_err(|error| {
            StoreError::Failed(format!("cannot store {}: {error}", path.display()))
        })?;
        Ok(pin)
    }

    pub fn get(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        match fs::read(self.path(digest)) {
            Ok(bytes) => Ok(Some(bytes.into())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(StoreError::Failed(format!("cannot read {digest}: {error}"))),
        }
    }

    /// Removes a blob that is neither pinned nor referenced. Returns the number of bytes removed; a file
    /// that cannot be removed is harmless and only takes up space.
    pub fn remove_unreferenced(&self, digest: &Digest, trees: &Trees) -> u64 {
        let pinned = self.pinned.lock();
        if pinned.contains_key(digest) || !trees.is_unreferenced(digest) {
            return 0;
        }
        let path = self.path(digest);
        let bytes = fs::metadata(&path).map_or(0, |found| found.len());
        match fs::remove_file(&path) {
            Ok(()) => bytes,
            Err(error) => {
                tracing::warn!(%digest, %error, "cannot remove image bytes");
                0
            }
        }
    }

    fn path(&self, digest: &Digest) -> PathBuf {
        path_of(&self.dir, digest)
    }
}

/// Returns the path of a blob in the folder of image bytes.
pub(super) fn path_of(dir: &Path, digest: &Digest) -> PathBuf {
    let hex = digest.hex();
    dir.join(&hex[..2]).join(&hex[2..])
}

fn write_durably(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let folder = path.parent().ok_or_else(|| io::Error::other("no parent folder"))?;
    if !folder.is_dir() {
        fs::create_dir_all(folder)?;
        if let Some(above) = folder.parent() {
            File::open(above)?.sync_all()?;
        }
    }
    // A unique name, so that concurrent writers of the same bytes do not collide.
    let temporary = path.with_extension(format!("{}.tmp", uuid::Uuid::now_v7().simple()));
    replace_durably(path, &temporary, bytes)?;
    File::open(folder)?.sync_all()
}

/// Writes and syncs a temporary file and renames it to `path`, so that readers never see a partial
/// file.
pub(super) fn replace_durably(path: &Path, temporary: &Path, bytes: &[u8]) -> io::Result<()> {
    let written = File::create(temporary).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(temporary, path)
    });
    if written.is_err() {
        let _ = fs::remove_file(temporary);
    }
    written
}
