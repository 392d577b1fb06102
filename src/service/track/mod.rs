//! Tracks: sequences of frames of one robot, whose estimates are filtered over time.
//!
//! [`belief`] is the filter, [`places`] the positions of the map's images. This file keeps the tracks in memory,
//! bounded in number and age; they do not survive a restart. The map of tracks is a plain one with strict LRU: moka and
//! quick_cache would evict newcomers first.

mod belief;
mod places;
mod settings;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::Mutex;
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::Instant;
use uuid::Uuid;

use self::belief::{Belief, Motion};
use self::places::Places;
pub use self::settings::TrackSettings;
use super::{Principal, ServiceError};
use whereabouts_api::{ErrorKind, TrackEstimate};
use whereabouts_core::{Calibration, Candidate, ImageId, Map};
use whereabouts_store::MapStore;

/// Minimum age of the cached positions of a map before they are read again, for maps that grow.
const POSITIONS_REFRESH: Duration = Duration::from_secs(2);

/// Minimum gap between the similarities of wrong answers; keeps the filter defined where all are equal.
const MIN_GAP: f32 = 1e-4;

/// Longest time between two frames that limits how far a robot may have moved.
const MAX_PAUSE_S: f64 = 86_400.0;

/// Maximum distance between two frames, in metres.
const MAX_MOVED_M: f64 = 1e6;

/// A frame's place in a track, as the robot states it.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackStep {
    /// The id of the track, chosen by the robot.
    id: String,
    /// The scope of the caller: tracks of different API keys are separate.
    owner: String,
    /// When the frame was taken.
    captured_at: Timestamp,
    /// How far the robot has moved since the previous frame, in metres, if it has odometry.
    moved_m: Option<f64>,
}

impl TrackStep {
    /// Validates a step; a frame without a time counts as taken now.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`](whereabouts_api::ErrorKind) for an invalid id or distance.
    pub fn new(
        caller: &Principal,
        id: String,
        captured_at: Option<Timestamp>,
        moved_m: Option<f64>,
    ) -> Result<Self, ServiceError> {
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.:".contains(&byte);
        if !(1..=64).contains(&id.len()) || !id.bytes().all(plain) {
            let shown: String = id.chars().take(80).collect();
            return Err(ServiceError::unprocessable(format!(
                "track {shown:?} must have 1 to 64 letters, digits, '-', '_', '.' and ':'"
            )));
        }
        if let Some(moved) = moved_m.filter(|moved| !(0.0..=MAX_MOVED_M).contains(moved)) {
            return Err(ServiceError::unprocessable(format!(
                "moved_m is {moved}; it must be the metres moved since the previous frame, 0 to {MAX_MOVED_M}"
            )));
        }
        let captured_at = captured_at.unwrap_or_else(Timestamp::now);
        Ok(Self { id, owner: caller.scope().to_owned(), captured_at, moved_m })
    }
}

/// The state of a track between two frames.
#[derive(Debug)]
struct Track {
    belief: Vec<(ImageId, f64)>,
    last: Timestamp,
    frames: u64,
}

/// A track with the time of its last use.
#[derive(Debug)]
struct TrackEntry {
    last_used: Instant,
    track: Arc<AsyncMutex<Track>>,
}

/// The cached positions of the images of one map.
#[derive(Debug, Clone)]
struct CachedPlaces {
    /// The revision of the map, and the number of changes of its images.
    version: (u32, u64),
    read_at: Instant,
    places: Arc<Places>,
}

/// All tracks, in memory.
pub struct Tracks {
    store: Arc<dyn MapStore>,
    /// Images closer than this many metres show the same place.
    place_m: f64,
    settings: Arc<TrackSettings>,
    /// By map, owner and id.
    tracks: Mutex<HashMap<Key, TrackEntry>>,
    maps: Mutex<HashMap<Uuid, CachedPlaces>>,
    /// Locked while positions are read, so that concurrent frames read them once.
    loading: AsyncMutex<()>,
}

/// A map, the owner of a track, and the owner's name for it.
type Key = (Uuid, String, String);

impl Tracks {
    /// An empty set of tracks.
    pub fn new(store: Arc<dyn MapStore>, place_m: f64, settings: TrackSettings) -> Self {
        Self {
            store,
            place_m,
            settings: Arc::new(settings),
            tracks: Mutex::default(),
            maps: Mutex::default(),
            loading: AsyncMutex::default(),
        }
    }

    /// The number of candidates that the filter uses.
    pub fn candidates(&self) -> usize {
        self.settings.candidates
    }

    /// Returns a track; a new one if it is not in memory or has been idle for too long.
    fn track(&self, key: &Key) -> Arc<AsyncMutex<Track>> {
        let mut tracks = self.tracks.lock();
        let now = Instant::now();
        let idle = Duration::from_secs(self.settings.idle_s);
        if let Some(known) = tracks.get_mut(key)
            && now.duration_since(known.last_used) <= idle
        {
            known.last_used = now;
            return Arc::clone(&known.track);
        }
        tracks.retain(|_, known| now.duration_since(known.last_used) <= idle);
        if tracks.len() >= self.settings.max
            && let Some((oldest, _)) = tracks.iter().min_by_key(|(_, known)| known.last_used)
        {
            let oldest = oldest.clone();
            tracing::warn!(
                track = oldest.2,
                max = self.settings.max,
                "the least recently used track was evicted; raise track.max if there are more robots"
            );
            tracks.remove(&oldest);
        }
        let track = Track { belief: Vec::new(), last: Timestamp::UNIX_EPOCH, frames: 0 };
        let track = Arc::new(AsyncMutex::new(track));
        tracks.insert(key.clone(), TrackEntry { last_used: now, track: Arc::clone(&track) });
        track
    }

    fn cached(&self, map: &Map, version: (u32, u64)) -> Option<Arc<Places>> {
        let maps = self.maps.lock();
        let known = maps.get(&map.uid)?;
        let fresh = known.version == version || known.read_at.elapsed() < POSITIONS_REFRESH;
        fresh.then(|| Arc::clone(&known.places))
    }

    /// Caches the positions of a map, and drops those of maps without tracks.
    fn cache(&self, map: &Map, version: (u32, u64), places: &Arc<Places>) {
        let used: Vec<Uuid> = {
            let tracks = self.tracks.lock();
            tracks.keys().map(|(uid, ..)| *uid).collect()
        };
        let mut maps = self.maps.lock();
        maps.retain(|uid, _| used.contains(uid));
        let known = CachedPlaces { version, read_at: Instant::now(), places: Arc::clone(places) };
        maps.insert(map.uid, known);
    }
}

impl Tracks {
    /// Updates a track with a frame and estimates the place. `candidates` are the images most similar to the frame.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`] in a map whose images have no poses.
    pub(super) async fn follow(
        &self,
        map: &Map,
        step: TrackStep,
        candidates: &[Candidate],
        calibration: &Calibration,
    ) -> Result<TrackEstimate, ServiceError> {
        let places = self.places(map).await?;
        if places.len() == 0 && !candidates.is_empty() {
            return Err(ServiceError::unprocessable(format!(
                "a track needs poses, and no image of the map {} has one; index them with poses, or \
                 leave track out",
                map.name
            )));
        }
        // The caller may have asked for more than the filter uses.
        let candidates = &candidates[..candidates.len().min(self.candidates())];
        let similarities: Vec<(u32, f32)> = candidates
            .iter()
            .filter_map(|candidate| {
                Some((places.number(&candidate.image_id)?, candidate.similarity))
            })
            .collect();
        let gap = calibration
            .similarity
            .mean()
            .unwrap_or_else(|| similarity_spread(candidates))
            .max(MIN_GAP);
        let TrackStep { id, owner, captured_at, .. } = step.clone();
        let track = self.track(&(map.uid, owner, id.clone()));
        // Concurrent frames of one track are processed one after another.
        let mut track = track.lock_owned().await;
        let (filtered, settings) = (Arc::clone(&places), Arc::clone(&self.settings));
        let (mut belief, frames) = on_blocking_thread(move || {
            let belief = track.predicted(&step, &filtered, &settings);
            let belief = belief.updated(&similarities, gap, &filtered, &settings);
            track.belief = belief.by_id(&filtered);
            (track.last, track.frames) = (captured_at, track.frames + 1);
            (belief, track.frames)
        })
        .await?;
        let place_m = self.place_m;
        let mut best = belief.best(&places, place_m);
        while let Some((image, _)) = best
            && self.store.image(map, places.id(image)).await?.is_none()
        {
            // Deleted since the positions were read.
            belief = belief.without(image);
            best = belief.best(&places, place_m);
        }
        let probability = best.map_or(0.0, |(_, probability)| probability);
        Ok(TrackEstimate {
            id,
            frames,
            image_id: best.map(|(image, _)| places.id(image).clone()),
            pose: best.map(|(image, _)| places.pose(image)),
            probability,
            known: probability >= self.settings.known_probability,
        })
    }

    async fn places(&self, map: &Map) -> Result<Arc<Places>, ServiceError> {
        let version = (map.revision, self.store.index_state(map).await?.changes);
        if let Some(places) = self.cached(map, version) {
            return Ok(places);
        }
        let _guard = self.loading.lock().await;
        if let Some(places) = self.cached(map, version) {
            return Ok(places);
        }
        let images = self.store.positions(map).await?;
        let places = Arc::new(on_blocking_thread(move || Places::new(images)).await?);
        self.cache(map, version, &places);
        Ok(places)
    }
}

/// Runs CPU-bound work outside the async threads.
async fn on_blocking_thread<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, ServiceError> {
    tokio::task::spawn_blocking(work).await.map_err(|error| {
        ServiceError::new(ErrorKind::Internal, format!("the track could not be computed: {error}"))
    })
}

impl Track {
    /// The belief when the next frame is taken.
    fn predicted(&self, step: &TrackStep, places: &Places, settings: &TrackSettings) -> Belief {
        if self.frames == 0 {
            return Belief::uniform();
        }
        let motion = step.moved_m.map_or_else(
            || {
                let elapsed = step.captured_at.duration_since(self.last).as_secs_f64();
                Motion::Within(settings.max_speed_m_s * elapsed.abs().min(MAX_PAUSE_S))
            },
            Motion::By,
        );
        Belief::from_ids(&self.belief, places).predicted(motion, places, settings)
    }
}

/// Estimates the gap of wrong answers in a map that is not calibrated yet: from the second candidate to the tenth.
fn similarity_spread(candidates: &[Candidate]) -> f32 {
    let similarity = |at: usize| candidates.get(at).map(|candidate| candidate.similarity);
    let last = candidates.len().min(10).saturating_sub(1);
    similarity(1).zip(similarity(last)).map_or(0.0, |(second, tenth)| second - tenth)
}
