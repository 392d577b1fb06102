//! Tracks: sequences of frames of one robot, whose estimates are filtered over time.
//!
//! [`belief`] is the filter over the [`paths`] of a map, [`moves`] and [`speeds`] are its motion model, [`presence`] says
//! whether the robot is on the map at all, [`posterior`] joins the two, [`evidence`] is what a frame says, [`odometry`]
//! and [`clock`] how the robot says that it moved and when, [`session`] one track, [`mod@prediction`] what it believes
//! before a frame, [`verdicts`] what a job says later, [`ground`] and [`grounds`] what all tracks in a map share,
//! [`mod@estimate`] the answer, and [`history`] and [`ways`] the way so far. [`memory`] keeps tracks, [`sharing`] and
//! [`record`] store them.

mod belief;
mod clock;
mod estimate;
mod evidence;
mod grid;
mod ground;
mod grounds;
mod history;
mod memory;
mod moves;
mod odometry;
mod paths;
mod posterior;
mod prediction;
mod presence;
mod record;
mod session;
mod settings;
mod sharing;
mod speeds;
mod verdicts;
mod ways;

use std::sync::Arc;

use jiff::Timestamp;

use self::estimate::estimate;
use self::ground::Ground;
use self::grounds::Grounds;
use self::memory::Memory;
pub use self::odometry::Odometry;
use self::posterior::{MIN_IMAGES, Posterior};
use self::prediction::Prediction;
use self::session::{Frame, Track};
pub use self::settings::TrackSettings;
use self::sharing::MAX_ATTEMPTS;
use self::verdicts::Waiting;
use super::{Principal, ServiceError};
use whereabouts_api::{ErrorKind, TrackEstimate};
use whereabouts_core::{Calibration, Candidate, Descriptor, Map};
use whereabouts_store::{MapStore, StoreError, TrackKey, TrackStore};

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

    /// The name of the track in a map.
    pub(crate) fn key(&self, map: &Map) -> TrackKey {
        TrackKey { map: map.uid, owner: self.owner.clone(), id: self.id.clone() }
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

/// All tracks.
pub struct Tracks {
    store: Arc<dyn MapStore>,
    /// Images closer than this many metres show the same place.
    place_m: f64,
    settings: Arc<TrackSettings>,
    stored: Arc<dyn TrackStore>,
    memory: Memory,
    grounds: Grounds,
    /// The jobs whose verdicts will be evidence.
    waiting: Waiting,
}

impl Tracks {
    /// The tracks in a store.
    pub fn new(
        store: Arc<dyn MapStore>,
        stored: Arc<dyn TrackStore>,
        place_m: f64,
        settings: TrackSettings,
    ) -> Self {
        let settings = Arc::new(settings);
        let (memory, grounds) = (Memory::default(), Grounds::default());
        Self {
            store,
            place_m,
            stored,
            memory,
            grounds,
            waiting: Waiting::new(settings.max),
            settings,
        }
    }

    /// The number of candidates that the filter uses.
    pub fn candidates(&self) -> usize {
        self.settings.candidates
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
        let key = step.key(map);
        let id = key.id.clone();
        let track = self.memory.track(&key, &self.settings);
        // Concurrent frames of one track are processed one after another.
        let mut held = track.lock_owned().await;
        let mut attempts = MAX_ATTEMPTS;
        let Answered { mut estimate, mut posterior, warning } = loop {
            self.refresh(&key, &mut held, &ground).await?;
            // A frame that fails leaves the track as it was.
            let next = held.track.clone();
            let frame = (step.clone(), frame, evidence);
            let (next, answered) = self.advance(map, &ground, next, frame).await?;
            attempts -= 1;
            if self.keep(&key, &mut held, next, &ground).await? {
                break answered;
            }
            if attempts == 0 {
                tracing::warn!(
                    track = id,
                    "other servers changed a track all the time: a frame is lost for it"
                );
                break answered;
            }
        };
        drop(held);
        loop {
            let Some(image) = estimate.image_id.as_ref().and_then(|id| ground.number(id)) else {
                return Ok((estimate, warning));
            };
            if self.store.image(map, ground.id(image)).await?.is_some() {
                return Ok((estimate, warning));
            }
            // Deleted since the positions were read.
            posterior = Arc::new(posterior.renumbered(&|other| (other != image).then_some(other)));
            let place = (estimate.id, estimate.frames, estimate.is_late);
            let (on, settings, place_m) =
                (Arc::clone(&ground), Arc::clone(&self.settings), self.place_m);
            let whole = Arc::clone(&posterior);
            let next = on_blocking_thread(move || place_of(place, &whole, &on, place_m, &settings));
            estimate = next.await?;
        }
    }

    /// Takes a frame into account.
    async fn advance(
        &self,
        map: &Map,
        ground: &Arc<Ground>,
        mut next: Track,
        (step, frame, evidence): (TrackStep, &Descriptor, Option<FrameEvidence<'_>>),
    ) -> Result<(Track, Answered), ServiceError> {
        let candidates = evidence.map(|evidence| evidence.candidates);
        let id = step.id.clone();
        next.enter(ground, map.revision);
        let is_informative = candidates.is_some();
        let (frame, on, settings) = (frame.clone(), Arc::clone(ground), Arc::clone(&self.settings));
        let (mut next, prediction) = on_blocking_thread(move || {
            let frame = Frame { descriptor: frame.as_slice(), is_informative };
            let prediction = next.predict(&step, frame, &on, &settings);
            (next, prediction)
        })
        .await?;
        let similar = match candidates {
            Some(candidates) => self.similarities(map, ground, &prediction, candidates).await?,
            None => None,
        };
        let (on, settings, place_m) =
            (Arc::clone(ground), Arc::clone(&self.settings), self.place_m);
        let (warning, is_late) = (prediction.warning.clone(), prediction.is_late);
        let confidence = evidence.and_then(|evidence| evidence.confidence);
        on_blocking_thread(move || {
            let similar = similar.map(|similar| similar.with_sample(&on, &prediction.frame));
            let Similar { images, similarities } = similar.unwrap_or_default();
            let similar = (images.as_slice(), similarities.as_slice());
            let weights = prediction.weights(similar, confidence, &on, &settings);
            let posterior = next.update(prediction, weights.as_ref(), &on, &settings);
            let place = (id, next.frames, is_late);
            let estimate = place_of(place, &posterior, &on, place_m, &settings);
            (next, Answered { estimate, posterior, warning })
        })
        .await
    }

    /// How similar the images are that matter to a track, but for the sample of the map; `None` if a reindex ended
    /// meanwhile, so that the frame only moves the belief.
    async fn similarities(
        &self,
        map: &Map,
        ground: &Arc<Ground>,
        prediction: &Prediction,
        candidates: &[Candidate],
    ) -> Result<Option<Similar>, ServiceError> {
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
            Ok(similarities) => Ok(Some(Similar { images, similarities })),
            Err(StoreError::Superseded(_)) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }
}

/// What the filter says after a frame.
struct Answered {
    estimate: TrackEstimate,
    posterior: Arc<Posterior>,
    /// What the robot should send instead.
    warning: Option<String>,
}

/// The answer to a frame: that of a number, of a track.
fn place_of(
    (id, frames, is_late): (String, u64, bool),
    posterior: &Posterior,
    ground: &Ground,
    place_m: f64,
    settings: &TrackSettings,
) -> TrackEstimate {
    let estimate = estimate((id, frames), posterior, ground, place_m, settings);
    // Without an image, it is no answer for another time.
    TrackEstimate { is_late: is_late && estimate.image_id.is_some(), ..estimate }
}

/// Images and the similarity of each to a frame.
#[derive(Default)]
struct Similar {
    images: Vec<u32>,
    similarities: Vec<Option<f32>>,
}

impl Similar {
    /// The same with the sample of the map, sorted by image. These are compared with every frame, and kept in memory.
    fn with_sample(self, ground: &Ground, frame: &[f32]) -> Self {
        let sample = ground.sample().iter().copied().zip(ground.sample_similarities(frame));
        let mut all: Vec<_> =
            self.images.into_iter().zip(self.similarities).chain(sample).collect();
        all.sort_unstable_by_key(|(image, _)| *image);
        let (images, similarities) = all.into_iter().unzip();
        Self { images, similarities }
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
