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
use super::super::{
    StoreError, StoredTrack, TrackHead, TrackKey, TrackRead, TrackState, TrackStore,
};
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
    last_frame_at: Timestamp,
    /// A track is written some seconds after its last frame, and its state says how long ago things were then.
    written_at: Timestamp,
}

impl Header {
    fn age(&self) -> Duration {
        since(self.written_at)
    }

    fn idle(&self) -> Duration {
        since(self.last_frame_at)
    }
}

/// How long ago a moment was; zero if the clock was set back since.
fn since(moment: Timestamp) -> Duration {
    Duration::try_from(Timestamp::now().duration_since(moment)).unwrap_or_default()
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

    /// The tracks in a map.
    fn list(&self, map: &Path) -> Vec<Header> {
        entries(map).iter().filter_map(|path| Some(read(path)?.0)).collect()
    }

    /// All tracks, each with its file. Removes the files that hold none, whose robots start new tracks.
    fn sweep(&self) -> Vec<(PathBuf, Header)> {
        let paths = entries(&self.folder).into_iter().flat_map(|map| entries(&map));
        let kept = paths.filter_map(|path| match read(&path) {
            Some((header, _)) => Some((path, header)),
            None => {
                tracing::warn!(path = %path.display(), "a stored track is damaged, and is removed");
                remove(fs::remove_file(&path), &path);
                None
            }
        });
        kept.collect()
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
                Some((header, state)) if header.idle() <= idle => {
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
        next: TrackState,
        idle: Duration,
    ) -> Result<Option<u64>, StoreError> {
        let (inner, key) = (Arc::clone(&self.inner), key.clone());
        blocking(move || {
            let path = inner.tracks.path(&key);
            let _writing = inner.tracks.writing.lock();
            let stored = read(&path).map(|(header, _)| header);
            let stored = stored.filter(|header| before.is_some() || header.idle() <= idle);
            if stored.map(|header| header.version) != before {
                return Ok(None);
            }
            let version = before.map_or_else(first_version, |before| before + 1);
            let TrackKey { owner, id, .. } = key;
            let TrackState { frames, last_frame_at, state } = next;
            let written_at = Timestamp::now();
            let header = Header { owner, id, version, frames, last_frame_at, written_at };
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
                .filter(|header| header.idle() <= idle)
                .filter(|header| id.as_ref().is_none_or(|id| *id == header.id))
                .collect();
            headers.sort_by_key(|header| std::cmp::Reverse(header.last_frame_at));
            headers.truncate(limit);
            let head = |Header { owner, id, frames, last_frame_at, .. }| TrackHead {
                owner,
                id,
                frames,
                last_frame_at,
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
            let mut all = files.sweep();
            all.sort_by_key(|(_, header)| std::cmp::Reverse(header.last_frame_at));
            let mut count = 0;
            for (number, (path, header)) in all.into_iter().enumerate() {
                if number >= most || header.idle() > idle {
                    remove(fs::remove_file(&path), &path);
                    count += 1;
                }
            }
            Ok(count)
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_records::{map, settings};
    use super::*;
    use crate::MapStore;

    #[tokio::test]
    async fn the_latest_frame_decides_which_tracks_stay_and_damaged_files_go() {
        const LONG: Duration = Duration::from_secs(600);
        let dir = tempfile::tempdir().unwrap();
        let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
        let (map, _) = store.put_map(map()).await.unwrap();
        let key = |id: &str| TrackKey { map: map.uid, owner: "-".into(), id: id.into() };
        // Written in one flush, in any order; the last of them drove a minute ago.
        for (id, seconds) in [("b", 2), ("a", 1), ("d", 60), ("c", 3)] {
            let last_frame_at = Timestamp::now() - Duration::from_secs(seconds);
            let next = TrackState { frames: 1, last_frame_at, state: Bytes::from_static(b"x") };
            store.put_track(&key(id), None, next, LONG).await.unwrap().unwrap();
        }
        let listed = async || -> Vec<String> {
            let heads = store.tracks(map.uid, None, 9, LONG).await.unwrap();
            heads.into_iter().map(|head| head.id).collect()
        };
        assert_eq!(listed().await, ["a", "b", "c", "d"]);
        assert_eq!(store.prune_tracks(Duration::from_secs(30), 2).await.unwrap(), 2);
        assert_eq!(listed().await, ["a", "b"]);
        let damaged = store.inner.tracks.path(&key("a"));
        fs::write(&damaged, "damaged").unwrap();
        assert_eq!(store.track(&key("a"), None, LONG).await.unwrap(), TrackRead::Missing);
        store.prune_tracks(LONG, 9).await.unwrap();
        assert!(!damaged.exists());
        assert_eq!(listed().await, ["b"]);
    }
}
