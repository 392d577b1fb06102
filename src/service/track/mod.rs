//! Tracks: the frames of one robot, one after another, which together say more than each alone.
//!
//! [`belief`] is the filter, [`places`] what it knows of the map. This file remembers the tracks: so many
//! of them, so long, in memory; a start begins them anew.

mod belief;
mod places;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::Mutex as AsyncMutex;
use uuid::Uuid;

use self::belief::{Belief, Motion};
use self::places::Places;
use super::{Principal, ServiceError};
use whereabouts_api::{ErrorKind, TrackEstimate};
use whereabouts_core::{Calibration, Candidate, ImageId, Map};
use whereabouts_store::MapStore;

/// The images of a map that grows are looked up again no sooner than this.
const REFRESH: Duration = Duration::from_secs(2);

/// The least gap between the similarities of wrong answers; keeps the filter defined where they are all
/// the same.
const LEAST_GAP: f32 = 1e-4;

/// After a pause of a day a robot is anywhere.
const LONGEST_PAUSE_S: f64 = 86_400.0;

/// No robot is faster, in metres a second.
const FASTEST_M_S: f64 = 1000.0;

/// A way between two frames is shorter than this, in metres.
const FARTHEST_M: f64 = 1e6;

/// `[track]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackSettings {
    /// Tracks that are remembered.
    pub max: usize,
    /// How long a track is remembered after its last frame, in seconds.
    pub idle_s: u64,
    /// How fast a robot without odometry may be, in metres a second.
    pub max_speed_m_s: f64,
    /// By how much of the way odometry may be wrong: a standard deviation.
    pub odometry_error: f64,
    /// The share of frames that say nothing.
    pub outliers: f64,
    /// The chance that a robot is anywhere when its next frame comes.
    pub jump: f64,
    /// How much similarity says: β of the filter.
    pub sharpness: f64,
    /// Images whose similarity counts; the others count as the last of these.
    pub candidates: usize,
    /// Images that are kept as likely.
    pub states: usize,
    /// The least probability of a known place.
    pub known_probability: f64,
}

impl TrackSettings {
    /// What is wrong with them, if anything.
    pub fn validate(&self) -> Option<String> {
        let share = |name: &str, value: f64| {
            let wrong = !(value > 0.0 && value < 1.0);
            wrong.then(|| format!("track.{name} = {value} must be above 0 and below 1"))
        };
        let above_zero = |name: &str, value: f64| {
            let wrong = !(value > 0.0 && value.is_finite());
            wrong.then(|| format!("track.{name} = {value} must be above 0"))
        };
        if self.max_speed_m_s > FASTEST_M_S {
            return Some(format!("track.max_speed_m_s must be at most {FASTEST_M_S}"));
        }
        let counts = [("max", self.max), ("candidates", self.candidates), ("states", self.states)];
        let zero = counts.into_iter().find(|(_, count)| *count == 0);
        zero.map(|(name, _)| format!("track.{name} must be at least 1"))
            .or_else(|| share("outliers", self.outliers))
            .or_else(|| share("jump", self.jump))
            .or_else(|| above_zero("max_speed_m_s", self.max_speed_m_s))
            .or_else(|| above_zero("odometry_error", self.odometry_error))
            .or_else(|| above_zero("sharpness", self.sharpness))
    }
}

/// What a robot says of a frame that belongs to a track.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackStep {
    /// Which track; the robot's own choice.
    id: String,
    /// Whose it is: those of one API key are not seen by another.
    owner: String,
    /// When the frame was taken.
    captured_at: Timestamp,
    /// How far the robot has come since the frame before, in metres, if it knows.
    moved_m: Option<f64>,
}

impl TrackStep {
    /// Checks what a robot says; a frame without a time was taken now.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`](super::ErrorKind) for an id that is none, and for a way that cannot be.
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
        if let Some(way) = moved_m.filter(|way| !(0.0..=FARTHEST_M).contains(way)) {
            return Err(ServiceError::unprocessable(format!(
                "moved_m is {way}; it must be the metres from the frame before, 0 to {FARTHEST_M}"
            )));
        }
        let captured_at = captured_at.unwrap_or_else(Timestamp::now);
        Ok(Self { id, owner: caller.scope().to_owned(), captured_at, moved_m })
    }
}

/// What is remembered of a track.
#[derive(Debug)]
struct Track {
    belief: Vec<(ImageId, f64)>,
    last: Timestamp,
    frames: u64,
}

/// A track, and when its last frame came.
#[derive(Debug)]
struct Remembered {
    used: Instant,
    track: Arc<AsyncMutex<Track>>,
}

/// The images of one map, as they were a moment ago.
#[derive(Debug, Clone)]
struct Known {
    /// The revision of the map, and how often its images have changed.
    version: (u32, u64),
    at: Instant,
    places: Arc<Places>,
}

/// All tracks.
pub struct Tracks {
    store: Arc<dyn MapStore>,
    /// Images closer than this many metres show the same place.
    place_m: f64,
    settings: Arc<TrackSettings>,
    /// By map, owner and id.
    tracks: Mutex<HashMap<Key, Remembered>>,
    maps: Mutex<HashMap<Uuid, Known>>,
    /// Held while the images of a map are laid out, so that not everybody does it.
    laying_out: AsyncMutex<()>,
}

/// A map, the owner of a track, and the owner's name for it.
type Key = (Uuid, String, String);

impl Tracks {
    /// No track yet.
    pub fn new(store: Arc<dyn MapStore>, place_m: f64, settings: TrackSettings) -> Self {
        Self {
            store,
            place_m,
            settings: Arc::new(settings),
            tracks: Mutex::default(),
            maps: Mutex::default(),
            laying_out: AsyncMutex::default(),
        }
    }

    /// How many images of a frame the filter wants to know of.
    pub fn candidates(&self) -> usize {
        self.settings.candidates
    }

    /// A track, which begins now unless it is remembered.
    fn track(&self, key: &Key) -> Arc<AsyncMutex<Track>> {
        let mut tracks = self.tracks.lock();
        let now = Instant::now();
        let idle = Duration::from_secs(self.settings.idle_s);
        if let Some(known) = tracks.get_mut(key)
            && now.duration_since(known.used) <= idle
        {
            known.used = now;
            return Arc::clone(&known.track);
        }
        tracks.retain(|_, known| now.duration_since(known.used) <= idle);
        if tracks.len() >= self.settings.max
            && let Some((oldest, _)) = tracks.iter().min_by_key(|(_, known)| known.used)
        {
            let oldest = oldest.clone();
            tracing::warn!(
                track = oldest.2,
                max = self.settings.max,
                "the track that was used least recently is forgotten; raise track.max if more robots drive"
            );
            tracks.remove(&oldest);
        }
        let track = Track { belief: Vec::new(), last: Timestamp::UNIX_EPOCH, frames: 0 };
        let track = Arc::new(AsyncMutex::new(track));
        tracks.insert(key.clone(), Remembered { used: now, track: Arc::clone(&track) });
        track
    }

    fn known(&self, map: &Map, version: (u32, u64)) -> Option<Arc<Places>> {
        let maps = self.maps.lock();
        let known = maps.get(&map.uid)?;
        let fresh = known.version == version || known.at.elapsed() < REFRESH;
        fresh.then(|| Arc::clone(&known.places))
    }

    /// Remembers the images of a map, and forgets those of maps that no track is in.
    fn know(&self, map: &Map, version: (u32, u64), places: &Arc<Places>) {
        let used: Vec<Uuid> = {
            let tracks = self.tracks.lock();
            tracks.keys().map(|(uid, ..)| *uid).collect()
        };
        let mut maps = self.maps.lock();
        maps.retain(|uid, _| used.contains(uid));
        let known = Known { version, at: Instant::now(), places: Arc::clone(places) };
        maps.insert(map.uid, known);
    }
}

impl Tracks {
    /// Takes a frame into its track. `candidates` are the images most similar to it.
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
        // Not more than the filter is set to, however many the caller asked for.
        let candidates = &candidates[..candidates.len().min(self.candidates())];
        let similarities: Vec<(u32, f32)> = candidates
            .iter()
            .filter_map(|one| Some((places.number(&one.image_id)?, one.similarity)))
            .collect();
        let gap =
            calibration.similarity.mean().unwrap_or_else(|| spread(candidates)).max(LEAST_GAP);
        let TrackStep { id, owner, captured_at, .. } = step.clone();
        let track = self.track(&(map.uid, owner, id.clone()));
        // Frames of one track that come at the same time are taken one after another.
        let mut track = track.lock_owned().await;
        let (filtered, settings) = (Arc::clone(&places), Arc::clone(&self.settings));
        let (mut belief, frames) = off_the_runtime(move || {
            let belief = track.moved(&step, &filtered, &settings);
            let belief = belief.given(&similarities, gap, &filtered, &settings);
            track.belief = belief.named(&filtered);
            (track.last, track.frames) = (captured_at, track.frames + 1);
            (belief, track.frames)
        })
        .await?;
        let place_m = self.place_m;
        let mut best = belief.best(&places, place_m);
        while let Some((image, _)) = best
            && self.store.image(map, places.id(image)).await?.is_none()
        {
            // It was deleted a moment ago, and is in no answer.
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
        if let Some(places) = self.known(map, version) {
            return Ok(places);
        }
        let _turn = self.laying_out.lock().await;
        if let Some(places) = self.known(map, version) {
            return Ok(places);
        }
        let images = self.store.positions(map).await?;
        let places = Arc::new(off_the_runtime(move || Places::new(images)).await?);
        self.know(map, version, &places);
        Ok(places)
    }
}

/// Works something out where it keeps no request waiting but its own.
async fn off_the_runtime<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, ServiceError> {
    tokio::task::spawn_blocking(work).await.map_err(|error| {
        ServiceError::new(
            ErrorKind::Internal,
            format!("the track could not be worked out: {error}"),
        )
    })
}

impl Track {
    /// Where the robot may be when its next frame is taken.
    fn moved(&self, step: &TrackStep, places: &Places, settings: &TrackSettings) -> Belief {
        if self.frames == 0 {
            return Belief::anywhere();
        }
        let motion = step.moved_m.map_or_else(
            || {
                let passed = step.captured_at.duration_since(self.last).as_secs_f64();
                Motion::Within(settings.max_speed_m_s * passed.abs().min(LONGEST_PAUSE_S))
            },
            Motion::By,
        );
        Belief::remembered(&self.belief, places).after(motion, places, settings)
    }
}

/// How far apart the similarities of images are that are probably all wrong, before that was measured.
fn spread(candidates: &[Candidate]) -> f32 {
    let similarity = |at: usize| candidates.get(at).map(|candidate| candidate.similarity);
    let last = candidates.len().min(10).saturating_sub(1);
    similarity(1).zip(similarity(last)).map_or(0.0, |(second, tenth)| second - tenth)
}
