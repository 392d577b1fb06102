//! The tracks in memory, bounded in number and age. A plain map with strict LRU: moka and quick_cache would evict
//! newcomers first.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::Instant;
use uuid::Uuid;

use super::TrackSettings;
use super::session::Track;
use whereabouts_store::TrackKey;

/// A track, and how much of it the store has.
#[derive(Debug)]
pub(super) struct Held {
    pub track: Track,
    /// The version in the store that it continues; `None` if the store has none.
    pub version: Option<u64>,
    /// Whether the store was asked for it.
    pub is_read: bool,
    /// Whether the store has it as it is.
    pub is_saved: bool,
}

impl Held {
    fn new() -> Self {
        Self { track: Track::new(), version: None, is_read: false, is_saved: true }
    }
}

/// A track that frames of a robot take turns to change.
pub(super) type SharedTrack = Arc<AsyncMutex<Held>>;

/// A track with the time of its last use.
#[derive(Debug)]
struct Entry {
    last_used: Instant,
    track: SharedTrack,
}

/// The tracks.
#[derive(Debug, Default)]
pub(super) struct Memory {
    tracks: Mutex<HashMap<TrackKey, Entry>>,
}

impl Memory {
    /// Returns a track; a new one if it is not in memory or has been idle for too long.
    pub fn track(&self, key: &TrackKey, settings: &TrackSettings) -> SharedTrack {
        let mut tracks = self.tracks.lock();
        let now = Instant::now();
        let idle = Duration::from_secs(settings.idle_s);
        if let Some(known) = tracks.get_mut(key)
            && now.duration_since(known.last_used) <= idle
        {
            known.last_used = now;
            return Arc::clone(&known.track);
        }
        tracks.retain(|_, known| now.duration_since(known.last_used) <= idle);
        if tracks.len() >= settings.max
            && let Some((oldest, _)) = tracks.iter().min_by_key(|(_, known)| known.last_used)
        {
            let oldest = oldest.clone();
            tracing::warn!(
                track = oldest.id,
                max = settings.max,
                "the least recently used track was evicted; raise track.max if there are more robots"
            );
            tracks.remove(&oldest);
        }
        let track = Arc::new(AsyncMutex::new(Held::new()));
        tracks.insert(key.clone(), Entry { last_used: now, track: Arc::clone(&track) });
        track
    }

    /// The tracks that a condition holds for and that have not expired, the last used first.
    pub fn known(
        &self,
        settings: &TrackSettings,
        is_wanted: impl Fn(&TrackKey) -> bool,
    ) -> Vec<(TrackKey, SharedTrack)> {
        let tracks = self.tracks.lock();
        let idle = Duration::from_secs(settings.idle_s);
        let is_known = |entry: &Entry| entry.last_used.elapsed() <= idle;
        let mut found: Vec<_> =
            tracks.iter().filter(|(key, entry)| is_wanted(key) && is_known(entry)).collect();
        found.sort_by_key(|(_, entry)| std::cmp::Reverse(entry.last_used));
        found.into_iter().map(|(key, entry)| (key.clone(), Arc::clone(&entry.track))).collect()
    }

    /// The maps that have tracks.
    pub fn maps(&self) -> Vec<Uuid> {
        self.tracks.lock().keys().map(|key| key.map).collect()
    }
}
