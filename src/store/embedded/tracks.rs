//! Tracks of robots, one file each: `DATA/tracks/UID/…`. sled is for small records that must not be lost; these are
//! large, change all the time, and may be lost with the machine. A file is replaced whole, so that a process that is
//! killed leaves the last version of each, and it ends with a checksum.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use jiff::Timestamp;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::super::tracks::first_version;
use super::super::{StoreError, StoredTrack, TrackHead, TrackKey, TrackRead, TrackStore};
use super::records::{decode, encode};
use super::{EmbeddedStore, blocking, create_folder};
use whereabouts_core::{Digest, Map};

/// The folder of the tracks.
pub(super) struct TrackFiles {
    folder: PathBuf,
    /// Locked while a file is read and replaced.
    writing: Mutex<()>,
}

/// What is before the state in a file.
#[derive(Debug, Serialize, Deserialize)]
struct Header {
    owner: String,
    id: String,
    version: u64,
    frames: u64,
    written_at: Timestamp,
}

impl Header {
    fn age(&self) -> Duration {
        let age = Timestamp::now().duration_since(self.written_at);
        // A clock that was set back.
        Duration::try_from(age).unwrap_or_default()
    }
}

impl TrackFiles {
    /// Opens the folder, and removes the tracks of maps that are gone.
    pub fn open(folder: PathBuf, maps: &[Map]) -> Result<Self, StoreError> {
        create_folder(&folder)?;
        let files = Self { folder, writing: Mutex::new(()) };
        let known: Vec<PathBuf> = maps.iter().map(|map| files.folder_of(map.uid)).collect();
        for folder in entries(&files.folder) {
            if !known.contains(&folder) {
                remove(fs::remove_dir_all(&folder), &folder);
            }
        }
        Ok(files)
    }

    fn folder_of(&self, map: Uuid) -> PathBuf {
        self.folder.join(map.simple().to_string())
    }

    fn path(&self, key: &TrackKey) -> PathBuf {
        let name = Digest::of(format!("{} {}", key.owner, key.id).as_bytes());
        self.folder_of(key.map).join(&name.hex()[..32])
    }

    /// Forgets the tracks in a map.
    pub fn forget(&self, map: Uuid) {
        let folder = self.folder_of(map);
        remove(fs::remove_dir_all(&folder), &folder);
    }

    /// The tracks in a map, each with its file.
    fn list(&self, map: &Path) -> Vec<(PathBuf, Header)> {
        let read = |path: PathBuf| Some((path.clone(), read(&path)?.0));
        entries(map).into_iter().filter_map(read).collect()
    }
}

/// The entries of a folder; none if it cannot be read.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten();
    entries.filter_map(|entry| Some(entry.ok()?.path())).collect()
}

fn remove(removed: io::Result<()>, path: &Path) {
    if let Err(error) = removed
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!(path = %path.display(), %error, "tracks cannot be removed");
    }
}

/// Reads a file. One that is missing or damaged is no track.
fn read(path: &Path) -> Option<(Header, Bytes)> {
    let bytes = fs::read(path).ok()?;
    let (body, checksum) = bytes.split_last_chunk::<4>()?;
    let (size, body) = body.split_first_chunk::<4>()?;
    if crc32fast::hash(body) != u32::from_le_bytes(*checksum) {
        return None;
    }
    let (header, state) = body.split_at_checked(u32::from_le_bytes(*size) as usize)?;
    Some((decode(header).ok()?, Bytes::copy_from_slice(state)))
}

fn write(path: &Path, header: &Header, state: &[u8]) -> Result<(), StoreError> {
    let header = encode(header)?;
    let size = u32::try_from(header.len()).unwrap_or(u32::MAX).to_le_bytes();
    let body = [header.as_slice(), state].concat();
    let checksum = crc32fast::hash(&body).to_le_bytes();
    let temporary = path.with_extension("tmp");
    let written = path
        .parent()
        .map_or(Ok(()), fs::create_dir_all)
        .and_then(|()| fs::write(&temporary, [&size, body.as_slice(), &checksum].concat()))
        .and_then(|()| fs::rename(&temporary, path));
    written.map_err(|error| {
        StoreError::Failed(format!("a track cannot be written to {}: {error}", path.display()))
    })
}

#[async_trait]
impl TrackStore for EmbeddedStore {
    fn shares_tracks(&self) -> bool {
        false
    }

    async fn track(
        &self,
        key: &TrackKey,
        known: Option<u64>,
        idle: Duration,
    ) -> Result<TrackRead, StoreError> {
        let (inner, key) = (Arc::clone(&self.inner), key.clone());
        blocking(move || {
            Ok(match read(&inner.tracks.path(&key)) {
                Some((header, _)) if Some(header.version) == known => TrackRead::Unchanged,
                Some((header, state)) if header.age() <= idle => {
                    let (version, age) = (header.version, header.age());
                    TrackRead::Found(StoredTrack { version, age, state })
                }
                _ => TrackRead::Missing,
            })
        })
        .await
    }

    async fn put_track(
        &self,
        key: &TrackKey,
        before: Option<u64>,
        (frames, state): (u64, Bytes),
        idle: Duration,
    ) -> Result<Option<u64>, StoreError> {
        let (inner, key) = (Arc::clone(&self.inner), key.clone());
        blocking(move || {
            let path = inner.tracks.path(&key);
            let _writing = inner.tracks.writing.lock();
            let stored = read(&path).map(|(header, _)| header);
            let stored = stored.filter(|header| before.is_some() || header.age() <= idle);
            if stored.map(|header| header.version) != before {
                return Ok(None);
            }
            let version = before.map_or_else(first_version, |before| before + 1);
            let TrackKey { owner, id, .. } = key;
            let header = Header { owner, id, version, frames, written_at: Timestamp::now() };
            write(&path, &header, &state)?;
            Ok(Some(version))
        })
        .await
    }

    async fn tracks(
        &self,
        map: Uuid,
        id: Option<&str>,
        limit: usize,
        idle: Duration,
    ) -> Result<Vec<TrackHead>, StoreError> {
        let (inner, id) = (Arc::clone(&self.inner), id.map(str::to_owned));
        blocking(move || {
            let mut headers: Vec<Header> = inner
                .tracks
                .list(&inner.tracks.folder_of(map))
                .into_iter()
                .map(|(_, header)| header)
                .filter(|header| header.age() <= idle)
                .filter(|header| id.as_ref().is_none_or(|id| *id == header.id))
                .collect();
            headers.sort_by_key(|header| std::cmp::Reverse(header.written_at));
            headers.truncate(limit);
            let head = |Header { owner, id, frames, written_at, .. }| TrackHead {
                owner,
                id,
                frames,
                written_at,
            };
            Ok(headers.into_iter().map(head).collect())
        })
        .await
    }

    async fn prune_tracks(&self, idle: Duration, most: usize) -> Result<usize, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || {
            let files = &inner.tracks;
            let _writing = files.writing.lock();
            let mut all: Vec<(PathBuf, Header)> =
                entries(&files.folder).iter().flat_map(|map| files.list(map)).collect();
            all.sort_by_key(|(_, header)| std::cmp::Reverse(header.written_at));
            let mut count = 0;
            for (number, (path, header)) in all.into_iter().enumerate() {
                if number >= most || header.age() > idle {
                    remove(fs::remove_file(&path), &path);
                    count += 1;
                }
            }
            Ok(count)
        })
        .await
    }
}
