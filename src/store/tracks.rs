//! Tracks of robots: what the filter knows of each after its last frame, in bytes of the filter's own.

use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use jiff::Timestamp;
use uuid::Uuid;

use super::StoreError;

/// Names a track.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct TrackKey {
    /// The uid of the map.
    pub map: Uuid,
    /// Whose track it is.
    pub owner: String,
    /// The owner's name for it.
    pub id: String,
}

/// What is stored of a track.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredTrack {
    /// Changes with each write, and differs from those of earlier tracks of the same name.
    pub version: u64,
    /// How long ago it was written, by the clock of the store.
    pub age: Duration,
    /// What the filter knows.
    pub state: Bytes,
}

/// What a writer knows of a track.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackState {
    /// Number of frames so far.
    pub frames: u64,
    /// When the last of them arrived.
    pub last_frame_at: Timestamp,
    /// What the filter knows.
    pub state: Bytes,
}

/// What a reader finds who may know the latest version.
#[derive(Debug, Clone, PartialEq)]
pub enum TrackRead {
    /// There is no track, or it has expired.
    Missing,
    /// The version is the one that the reader knows.
    Unchanged,
    /// There is another version.
    Found(StoredTrack),
}

/// A track in a list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TrackHead {
    /// Whose track it is.
    pub owner: String,
    /// The owner's name for it.
    pub id: String,
    /// Number of frames so far.
    pub frames: u64,
    /// When the last of them arrived.
    pub last_frame_at: Timestamp,
}

/// Tracks of robots. They are derived from frames that a robot keeps sending, so they may be lost when the machine or
/// the database crashes. They expire `idle` after their last frame.
#[async_trait]
pub trait TrackStore: Send + Sync {
    /// Whether other processes continue the tracks of this one, so that it must store each frame, and read what another
    /// has stored, before it answers.
    fn shares_tracks(&self) -> bool;
    /// Reads a track, unless its version is the one that the caller knows.
    async fn track(
        &self,
        key: &TrackKey,
        known: Option<u64>,
        idle: Duration,
    ) -> Result<TrackRead, StoreError>;
    /// Replaces version `before` of a track; `None` stands for no track, or one that has expired. Returns the new
    /// version, or `None`, having changed nothing, if another one is stored.
    async fn put_track(
        &self,
        key: &TrackKey,
        before: Option<u64>,
        next: TrackState,
        idle: Duration,
    ) -> Result<Option<u64>, StoreError>;
    /// Returns up to `limit` tracks in a map, those with the latest frame first; with `id`, only those of this name.
    async fn tracks(
        &self,
        map: Uuid,
        id: Option<&str>,
        limit: usize,
        idle: Duration,
    ) -> Result<Vec<TrackHead>, StoreError>;
    /// Deletes the tracks that have expired, and the oldest of those in excess of `most`. Returns the number deleted.
    async fn prune_tracks(&self, idle: Duration, most: usize) -> Result<usize, StoreError>;
}

/// The first version of a track.
pub(super) fn first_version() -> u64 {
    // Half of it is free, so that it never ends; and a bigint has no room for the sign.
    Uuid::now_v7().as_u64_pair().1 >> 2
}
