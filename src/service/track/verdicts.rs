//! What a job says about a frame when it ends, some frames later.
//!
//! The verdict of a job is an image and a confidence c: of frames whose place is another, at most a share 1 − c is
//! answered with that confidence. At the time of its frame it is therefore evidence by the factor R = 1 / (1 − c), at most
//! [`MOST`]. The robot has moved since. With the prediction q of a robot that was then at the image, moved by what the
//! frames since said of the motion, the weight of the place x is now
//!
//! > L(x) = 1 + (R − 1) min(1, n q(x))
//!
//! where n is the number of images of the place: 1 where no robot can have come to, R where every robot came from there.
//! The frames in between have said their own already.
//!
//! Off the map, the confidence of a verdict is distributed evenly from 0 to 1, and any image may be named. For a robot on
//! the map, high confidences are more usual: a likelihood ratio of ω + (1 − ω) / (2 √(1 − c)), whose mean off the map is 1,
//! is therefore evidence of being on the map, as far as the verdict names a place that was expected. A low confidence is
//! evidence against it.

use std::collections::HashMap;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::super::{Jobs, ServiceError};
use super::belief::Belief;
use super::evidence::Weights;
use super::ground::Ground;
use super::posterior::Posterior;
use super::prediction::Changes;
use super::presence::LEVELS;
use super::session::{Track, habits};
use super::sharing::MAX_ATTEMPTS;
use super::speeds::STATES;
use super::{TrackSettings, Tracks, on_blocking_thread};
use whereabouts_core::{ImageId, JobState};
use whereabouts_store::TrackKey;

/// Number of frames after which a verdict comes too late.
pub(super) const VERDICT_STEPS: usize = 64;

/// The most that a verdict may count.
const MOST: f64 = 20.0;

/// Share of verdicts about frames on the map that are no better than those off it: ω.
const SAYS_NOTHING: f64 = 0.35;

/// No verdict is more certain than this.
const LEAST_DOUBT: f64 = 0.01;

/// Standard deviation of the kernel by which the images around that of a verdict are its place, in units of the usual
/// distance of neighbours.
const PLACE: f64 = 0.7;

/// Maximum number of images of a place.
const MAX_PLACE: usize = 64;

/// Jobs that are waited for, for each track that may be in memory.
const JOBS_EACH: usize = 8;

/// What a job says about a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Verdict {
    /// The number of the frame in its track.
    pub frame: u64,
    pub image: u32,
    pub confidence: f64,
}

/// The frame that a job is about.
#[derive(Debug, Clone)]
struct Subject {
    track: TrackKey,
    frame: u64,
    since: Instant,
}

/// The jobs whose verdicts are waited for, bounded in number and age.
#[derive(Debug)]
pub(super) struct Waiting {
    jobs: Mutex<HashMap<Uuid, Subject>>,
    most: usize,
}

impl Waiting {
    /// For so many tracks.
    pub fn new(tracks: usize) -> Self {
        Self { jobs: Mutex::default(), most: tracks.saturating_mul(JOBS_EACH) }
    }

    fn add(&self, job: Uuid, subject: Subject, idle: Duration) {
        let mut jobs = self.jobs.lock();
        if jobs.len() >= self.most {
            jobs.retain(|_, subject| subject.since.elapsed() <= idle);
        }
        // Those that are left will be told first.
        if jobs.len() < self.most {
            jobs.insert(job, subject);
        }
    }

    fn get(&self, job: Uuid) -> Option<Subject> {
        self.jobs.lock().get(&job).cloned()
    }

    fn remove(&self, job: Uuid) {
        self.jobs.lock().remove(&job);
    }

    fn all(&self) -> Vec<Uuid> {
        self.jobs.lock().keys().copied().collect()
    }
}

impl Track {
    /// Takes a verdict into account. Returns `false`, having changed nothing, if it says nothing or comes too late.
    pub fn learn(
        &mut self,
        Verdict { frame, image, confidence }: Verdict,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> bool {
        let factor = (1.0 / (1.0 - confidence).max(1.0 / MOST)).min(MOST);
        let Some(at) = self.steps.iter().position(|step| step.frame == frame) else { return false };
        if factor <= 1.0 {
            return false;
        }
        let (mut belief, images) = at_place(image, ground);
        for step in self.steps.range(at + 1..) {
            // Two robots share the track, or a clock was set.
            let Some(motion) = step.motion else { return false };
            let changes = Changes(ground.changes(belief.images()));
            let habits = habits(step.max_speed, settings);
            let (moved, _) = belief.predicted(motion, habits, changes.roads(ground));
            belief = moved.pruned(settings.states);
        }
        let count = ground.len().max(1) as f64;
        let share = belief.elsewhere() / count;
        let weight = |q: f64| 1.0 + (factor - 1.0) * (images * (q + share)).min(1.0);
        let mut known: Vec<(u32, f64)> = belief.masses();
        known.iter_mut().for_each(|(_, mass)| *mass = weight(*mass));
        known.sort_unstable_by_key(|(image, _)| *image);
        let weights = Weights::given(known, weight(0.0));
        let Posterior { belief, presence } = &*self.posterior;
        let expected = (weights.mean(belief, ground.len()) - 1.0) / (factor - 1.0);
        let ratio = 1.0 + expected.clamp(0.0, 1.0) * (presence_ratio(confidence) - 1.0);
        self.posterior = Posterior {
            belief: belief.updated(&weights, ground.len(), settings.states),
            presence: presence.updated(&[ratio; LEVELS], factor, 1.0),
        }
        .into();
        true
    }
}

/// How much more usual a confidence is on the map than off it.
fn presence_ratio(confidence: f64) -> f64 {
    SAYS_NOTHING + (1.0 - SAYS_NOTHING) / (2.0 * (1.0 - confidence).max(LEAST_DOUBT).sqrt())
}

/// The belief that a robot is at the place of an image, in any direction and at any speed, and the number of images of
/// the place.
fn at_place(image: u32, ground: &Ground) -> (Belief, f64) {
    let spacing = ground.paths.spacing();
    let near = ground.grid.near(image, 2.0 * PLACE * spacing, MAX_PLACE);
    let near = near.unwrap_or_else(|| vec![(image, 0.0)]);
    let weight = |metres: f64| (-0.5 * (metres / (PLACE * spacing)).powi(2)).exp();
    let number: f64 = near.iter().map(|(_, metres)| weight(*metres)).sum();
    let (images, states) = near
        .iter()
        .map(|(image, metres)| {
            let mass = weight(*metres) / number / STATES as f64;
            (*image, [mass as f32; STATES])
        })
        .unzip();
    (Belief::with_rest(images, states), number)
}

impl Tracks {
    /// Waits for the verdict of a job about a frame of a track, if verdicts enter tracks.
    pub(crate) fn await_verdict(&self, job: Uuid, track: TrackKey, frame: u64) {
        if !self.settings.verdicts {
            return;
        }
        let subject = Subject { track, frame, since: Instant::now() };
        self.waiting.add(job, subject, self.idle());
    }

    /// Takes the verdicts of jobs into account as they end, until `shutdown`.
    pub async fn heed(&self, jobs: &Jobs, shutdown: CancellationToken) {
        let mut changes = jobs.store.changes();
        loop {
            let changed = tokio::select! {
                () = shutdown.cancelled() => return,
                changed = changes.recv() => changed,
            };
            let changed = match changed {
                Ok(job) => vec![job],
                Err(RecvError::Lagged(_)) => self.waiting.all(),
                Err(RecvError::Closed) => return,
            };
            for job in changed {
                if let Err(error) = self.hear(jobs, job).await {
                    tracing::debug!(%job, %error, "the verdict of a job was not taken into account");
                }
            }
        }
    }

    /// Takes the verdict of a job into account, if it has ended and belongs to a frame of a track.
    pub(crate) async fn hear(&self, jobs: &Jobs, id: Uuid) -> Result<(), ServiceError> {
        let Some(subject) = self.waiting.get(id) else { return Ok(()) };
        let job = jobs.get(id, None).await?;
        if !job.state.is_final() {
            return Ok(());
        }
        self.waiting.remove(id);
        let estimate = job.estimate.filter(|estimate| estimate.reason.is_none());
        let confidence = estimate.as_ref().and_then(|estimate| estimate.confidence);
        // What fell back to the order of the search says nothing new.
        if let Some((estimate, confidence)) = estimate.zip(confidence)
            && job.state == JobState::Succeeded
        {
            self.learn(jobs, id, subject, (&estimate.image_id, f64::from(confidence))).await?;
        }
        Ok(())
    }

    async fn learn(
        &self,
        jobs: &Jobs,
        job: Uuid,
        Subject { track: key, frame, .. }: Subject,
        (image, confidence): (&ImageId, f64),
    ) -> Result<(), ServiceError> {
        let Some(record) = jobs.store.job(job).await? else { return Ok(()) };
        let Some(map) = record.map(&*self.store).await? else { return Ok(()) };
        let ground = self.ground(&map).await?;
        let Some(image) = ground.number(image) else { return Ok(()) };
        let verdict = Verdict { frame, image, confidence };
        // A track that was evicted is not brought back by it.
        let known = self.memory.known(&self.settings, |known| *known == key);
        let Some((_, track)) = known.into_iter().next() else { return Ok(()) };
        let mut held = track.lock_owned().await;
        for _ in 0..MAX_ATTEMPTS {
            self.refresh(&key, &mut held, &ground).await?;
            let mut next = held.track.clone();
            next.enter(&ground, map.revision);
            let (on, settings) = (ground.clone(), self.settings.clone());
            let (next, is_new) = on_blocking_thread(move || {
                let is_new = next.learn(verdict, &on, &settings);
                (next, is_new)
            })
            .await?;
            if !is_new || self.keep(&key, &mut held, next, &ground).await? {
                break;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
