//! Tracks: sequences of frames of one robot, whose estimates are filtered over time.
//!
//! [`belief`] is the filter over the [`paths`] of a map, [`moves`] and [`speeds`] are its motion model, [`presence`] says
//! whether the robot is on the map at all, [`posterior`] joins the two, [`evidence`] is what a frame says, [`odometry`] and [`clock`] how the robot says that it moved and when, [`session`] one track, [`ground`] what all tracks in
//! a map share, [`mod@estimate`] the answer, and [`history`] and [`ways`] the way so far. This file keeps the tracks in memory, bounded in number and age; they do
//! not survive a restart. The map of tracks is a plain one with strict LRU: moka and quick_cache would evict newcomers
//! first.

mod belief;
mod clock;
mod estimate;
mod evidence;
mod grid;
mod ground;
mod history;
mod moves;
mod odometry;
mod paths;
mod posterior;
mod presence;
mod session;
mod settings;
mod speeds;
mod ways;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::Mutex;
use tokio::sync::Mutex as AsyncMutex;
use tokio::time::Instant;
use uuid::Uuid;

use self::estimate::estimate;
use self::ground::{Ground, Known};
pub use self::odometry::Odometry;
use self::posterior::MIN_IMAGES;
use self::session::{Frame, Prediction, Track};
pub use self::settings::TrackSettings;
use super::{Principal, ServiceError};
use whereabouts_api::{ErrorKind, TrackEstimate};
use whereabouts_core::{Calibration, Candidate, Descriptor, Map};
use whereabouts_store::{MapStore, StoreError};

/// Minimum age of the cached positions of a map before they are read again, for maps that grow.
const POSITIONS_REFRESH: Duration = Duration::from_secs(2);

/// A frame's place in a track, as the robot states it.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackStep {
    /// The id of the track, chosen by the robot.
    id: String,
    /// The scope of the caller: tracks of different API keys are separate.
    owner: String,
    /// When the frame was taken, if the robot says so.
    captured_at: Option<Timestamp>,
    /// How the robot has moved since the previous frame, if it has odometry.
    odometry: Option<Odometry>,
}

impl TrackStep {
    /// Validates a step.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`](whereabouts_api::ErrorKind) for an invalid id.
    pub fn new(
        caller: &Principal,
        id: String,
        captured_at: Option<Timestamp>,
        odometry: Option<Odometry>,
    ) -> Result<Self, ServiceError> {
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.:".contains(&byte);
        // Clients resolve the paths `.` and `..`.
        let is_named = id.bytes().any(|byte| byte.is_ascii_alphanumeric());
        if !(1..=64).contains(&id.len()) || !id.bytes().all(plain) || !is_named {
            let shown: String = id.chars().take(80).collect();
            return Err(ServiceError::unprocessable(format!(
                "track {shown:?} must have 1 to 64 letters, digits, '-', '_', '.' and ':', and a letter or digit among them"
            )));
        }
        Ok(Self { id, owner: caller.scope().to_owned(), captured_at, odometry })
    }
}

/// What a frame says alone.
#[derive(Debug, Clone, Copy)]
pub struct FrameEvidence<'a> {
    /// The images most similar to it, best first.
    pub candidates: &'a [Candidate],
    /// The confidence of the first, calibrated on the map; `None` without a usable calibration.
    pub confidence: Option<f32>,
}

impl<'a> FrameEvidence<'a> {
    /// The evidence of candidates in a map with this calibration.
    pub fn new(candidates: &'a [Candidate], calibration: &Calibration) -> Self {
        let is_usable = calibration.similarity.len() >= MIN_IMAGES;
        let confidence = calibration.exceeded(candidates).filter(|_| is_usable);
        Self { candidates, confidence }
    }
}

/// A track with the time of its last use.
#[derive(Debug)]
struct TrackEntry {
    last_used: Instant,
    track: Arc<AsyncMutex<Track>>,
}

impl TrackEntry {
    fn is_idle(&self, settings: &TrackSettings) -> bool {
        self.last_used.elapsed() > Duration::from_secs(settings.idle_s)
    }
}

/// What tracks know of one map.
#[derive(Debug, Clone)]
struct CachedGround {
    /// The revision of the map, and the number of changes of its images.
    version: (u32, u64),
    read_at: Instant,
    ground: Arc<Ground>,
}

/// All tracks, in memory.
pub struct Tracks {
    store: Arc<dyn MapStore>,
    /// Images closer than this many metres show the same place.
    place_m: f64,
    settings: Arc<TrackSettings>,
    /// By map, owner and id.
    tracks: Mutex<HashMap<Key, TrackEntry>>,
    maps: Mutex<HashMap<Uuid, CachedGround>>,
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
        let track = Arc::new(AsyncMutex::new(Track::new()));
        tracks.insert(key.clone(), TrackEntry { last_used: now, track: Arc::clone(&track) });
        track
    }

    fn cached(&self, map: &Map, version: (u32, u64)) -> Option<Arc<Ground>> {
        let maps = self.maps.lock();
        let known = maps.get(&map.uid)?;
        // Descriptors of another revision cannot be compared.
        // A map that had no poses may have some now.
        let is_recent = known.ground.len() > 0 && known.read_at.elapsed() < POSITIONS_REFRESH;
        let fresh = known.version == version || (known.version.0 == version.0 && is_recent);
        fresh.then(|| Arc::clone(&known.ground))
    }

    /// Caches what tracks know of a map, and drops those of maps without tracks.
    fn cache(&self, map: &Map, version: (u32, u64), ground: &Arc<Ground>) {
        let used: Vec<Uuid> = {
            let tracks = self.tracks.lock();
            tracks.keys().map(|(uid, ..)| *uid).collect()
        };
        let mut maps = self.maps.lock();
        maps.retain(|uid, _| used.contains(uid));
        let known = CachedGround { version, read_at: Instant::now(), ground: Arc::clone(ground) };
        maps.insert(map.uid, known);
    }
}

impl Tracks {
    /// Updates a track with a frame and estimates the place; returns also what the robot should send instead.
    /// `evidence` is what the frame alone says, `None` if it shows nothing.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`] in a map whose images have no poses.
    pub async fn follow(
        &self,
        map: &Map,
        step: TrackStep,
        frame: &Descriptor,
        evidence: Option<FrameEvidence<'_>>,
    ) -> Result<(TrackEstimate, Option<String>), ServiceError> {
        let candidates = evidence.map(|evidence| evidence.candidates);
        let ground = self.ground(map).await?;
        if ground.len() == 0 && candidates.is_some_and(|candidates| !candidates.is_empty()) {
            return Err(ServiceError::unprocessable(format!(
                "a track needs poses, and no image of the map {} has one; index them with poses, or \
                 leave track out",
                map.name
            )));
        }
        let TrackStep { id, owner, .. } = step.clone();
        let track = self.track(&(map.uid, owner, id.clone()));
        // Concurrent frames of one track are processed one after another.
        let mut track = track.lock_owned().await;
        // A frame that fails leaves the track as it was.
        let mut next = track.clone();
        next.enter(&ground, map.revision);
        let is_informative = candidates.is_some();
        let (frame, on, settings) =
            (frame.clone(), Arc::clone(&ground), Arc::clone(&self.settings));
        let (mut next, prediction) = on_blocking_thread(move || {
            let frame = Frame { descriptor: frame.as_slice(), is_informative };
            let prediction = next.predict(&step, frame, &on, &settings);
            (next, prediction)
        })
        .await?;
        let similar = match candidates {
            Some(candidates) => self.similarities(map, &ground, &prediction, candidates).await?,
            None => Similar::default(),
        };
        let (on, settings) = (Arc::clone(&ground), Arc::clone(&self.settings));
        let (warning, is_late) = (prediction.warning.clone(), prediction.is_late);
        let confidence = evidence.and_then(|evidence| evidence.confidence);
        let (next, posterior) = on_blocking_thread(move || {
            let Similar { images, similarities } = similar;
            let similar = (images.as_slice(), similarities.as_slice());
            let weights = prediction.weights(similar, confidence, &on, &settings);
            let posterior = next.update(prediction, weights.as_ref(), &on, &settings);
            (next, posterior)
        })
        .await?;
        let frames = next.frames;
        *track = next;
        drop(track);
        let mut posterior = posterior;
        loop {
            let place = (id.clone(), frames);
            let (on, settings, place_m) =
                (Arc::clone(&ground), Arc::clone(&self.settings), self.place_m);
            let whole = Arc::clone(&posterior);
            let estimate =
                on_blocking_thread(move || estimate(place, &whole, &on, place_m, &settings))
                    .await?;
            let Some(image) = estimate.image_id.as_ref().and_then(|id| ground.number(id)) else {
                return Ok((estimate, warning));
            };
            if self.store.image(map, ground.id(image)).await?.is_some() {
                return Ok((TrackEstimate { is_late, ..estimate }, warning));
            }
            // Deleted since the positions were read.
            posterior = Arc::new(posterior.renumbered(&|other| (other != image).then_some(other)));
        }
    }

    /// How similar the images are that matter to a track.
    async fn similarities(
        &self,
        map: &Map,
        ground: &Arc<Ground>,
        prediction: &Prediction,
        candidates: &[Candidate],
    ) -> Result<Similar, ServiceError> {
        // The caller may have asked for more than the filter uses.
        let candidates = &candidates[..candidates.len().min(self.candidates())];
        let candidates: Vec<u32> =
            candidates.iter().filter_map(|candidate| ground.number(&candidate.image_id)).collect();
        let images = prediction.images(&candidates, ground);
        let read = async {
            let unknown = ground.unknown(&images);
            if !unknown.is_empty() {
                let known = self.descriptors(map, ground, &unknown).await?;
                ground.learn(&images, &known);
            }
            self.store.similarities(map, prediction.frame.clone(), ground.slots(&images)).await
        };
        match read.await {
            Ok(similarities) => Ok(Similar { images, similarities }),
            // A reindex ended meanwhile: this frame only moves the belief.
            Err(StoreError::Superseded(_)) => Ok(Similar::default()),
            Err(error) => Err(error.into()),
        }
    }

    async fn descriptors(
        &self,
        map: &Map,
        ground: &Ground,
        images: &[u32],
    ) -> Result<Known, StoreError> {
        let descriptors = self.store.descriptors(map, ground.slots(images)).await?;
        let known = images.iter().copied().zip(descriptors);
        Ok(known.filter_map(|(image, descriptor)| Some((image, descriptor?))).collect())
    }

    async fn ground(&self, map: &Map) -> Result<Arc<Ground>, ServiceError> {
        let version = (map.revision, self.store.index_state(map).await?.changes);
        if let Some(ground) = self.cached(map, version) {
            return Ok(ground);
        }
        let _guard = self.loading.lock().await;
        if let Some(ground) = self.cached(map, version) {
            return Ok(ground);
        }
        let images = self.store.positions(map).await?;
        let mut ground = on_blocking_thread(move || Ground::new(images)).await?;
        let sample = ground.sample_with_neighbours();
        let known = self.descriptors(map, &ground, &sample).await?;
        ground.learn_common(&known);
        let ground = Arc::new(ground);
        self.cache(map, version, &ground);
        Ok(ground)
    }
}

/// Images and the similarity of each to a frame.
#[derive(Default)]
struct Similar {
    images: Vec<u32>,
    similarities: Vec<Option<f32>>,
}

/// Runs CPU-bound work outside the async threads.
async fn on_blocking_thread<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, ServiceError> {
    tokio::task::spawn_blocking(work).await.map_err(|error| {
        ServiceError::new(ErrorKind::Internal, format!("the track could not be computed: {error}"))
    })
}
