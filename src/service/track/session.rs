//! One track: what the filter knows of a robot, and the steps that change it.

use std::collections::VecDeque;
use std::sync::Arc;

use jiff::Timestamp;
use tokio::time::Instant;

use super::belief::{Belief, Habits, Roads};
use super::evidence::{Frames, Weights};
use super::ground::Ground;
use super::moves::Motion;
use super::odometry::{Odometer, Odometry};
use super::{TrackSettings, TrackStep};

/// Number of beliefs kept for frames that arrive late.
const KEPT: usize = 8;

/// Longest time between two frames that limits how far a robot may have moved.
const MAX_PAUSE_S: f64 = 86_400.0;

/// A robot whose frames have no times moves at most this far from one to the next, in units of the usual distance of
/// neighbours in the map.
const MAX_RATE: f64 = 8.0;

/// A pause of this many times the usual interval of frames without times is a pause, and not jitter.
const PAUSE: f64 = 3.0;

/// Weight of a new interval in the usual one.
const INTERVAL_WEIGHT: f64 = 0.2;

/// Shortest interval of frames in seconds.
const MIN_INTERVAL_S: f64 = 1e-4;

/// Number of frames after which the rate of frames without times is judged.
const JUDGED: u64 = 5;

/// Probability from which on a robot without times is told that it is too fast.
const SURE: f64 = 0.9;

/// Probability that a robot which turned by more than two right angles, or reversed, now moves the other way on its
/// path.
const TURNED: f64 = 0.8;

/// The state of a track between two frames.
#[derive(Debug, Clone)]
pub(super) struct Track {
    belief: Arc<Belief>,
    /// The map that the belief refers to.
    ground: Option<Arc<Ground>>,
    /// The revision of that map: descriptors of another one cannot be compared.
    revision: u32,
    pub frames: u64,
    seen: Frames,
    odometer: Odometer,
    last: Option<Last>,
    /// The usual time between two arrivals in seconds.
    interval: Option<f64>,
    /// The latest beliefs, with the times that their robot stated.
    kept: VecDeque<(Timestamp, Arc<Belief>)>,
}

/// A frame, as the filter takes it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame<'a> {
    pub descriptor: &'a [f32],
    /// Whether it shows anything.
    pub is_informative: bool,
}

/// The frame before.
#[derive(Debug, Clone, Copy)]
struct Last {
    captured_at: Option<Timestamp>,
    arrived: Instant,
}

/// The belief before a frame is taken into account.
#[derive(Debug, Clone)]
pub(super) struct Prediction {
    belief: Belief,
    /// Share of the evidence of the frame that is new.
    fresh: f64,
    /// Whether the frame is older than the last one.
    pub is_late: bool,
    /// The frame without what it has in common with others.
    pub frame: Vec<f32>,
    /// What the robot should send instead.
    pub warning: Option<String>,
}

impl Track {
    /// A track without frames.
    pub fn new() -> Self {
        Self {
            belief: Arc::new(Belief::uniform()),
            ground: None,
            revision: 0,
            frames: 0,
            seen: Frames::default(),
            odometer: Odometer::default(),
            last: None,
            interval: None,
            kept: VecDeque::new(),
        }
    }

    /// Refers the track to the current state of its map.
    pub fn enter(&mut self, ground: &Arc<Ground>, revision: u32) {
        if self.revision != revision {
            (self.seen, self.revision) = (Frames::default(), revision);
        }
        if let Some(before) = &self.ground
            && !Arc::ptr_eq(before, ground)
        {
            let number = |image: u32| ground.number(before.id(image));
            self.belief = Arc::new(self.belief.renumbered(&number));
            for (_, belief) in &mut self.kept {
                *belief = Arc::new(belief.renumbered(&number));
            }
        }
        self.ground = Some(Arc::clone(ground));
    }

    /// The prediction step: the belief when a frame is taken. `frame` is its descriptor.
    pub fn predict(
        &mut self,
        step: &TrackStep,
        frame: Frame,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Prediction {
        let now = Instant::now();
        let last = self.last;
        let before = last.and_then(|last| last.captured_at);
        let late = step.captured_at.zip(before).filter(|(at, before)| at < before);
        if let Some((at, _)) = late {
            return self.predict_late(at, frame.descriptor, ground, settings);
        }
        let arrived = last.map(|last| now.duration_since(last.arrived).as_secs_f64());
        let spacing = ground.paths.spacing();
        // The frames' own rate is more than the clock can tell.
        let usual = self.interval;
        let elapsed = match (step.captured_at.zip(before), arrived) {
            (Some((at, before)), _) => at.duration_since(before).as_secs_f64().min(MAX_PAUSE_S),
            (None, Some(arrived)) => {
                let pause = arrived / usual.unwrap_or(arrived).max(MIN_INTERVAL_S);
                if pause > PAUSE { pause } else { 1.0 }
            }
            (None, None) => 0.0,
        };
        let by_rate = MAX_RATE * spacing;
        let max_speed = match step.captured_at.is_some() && before.is_some() {
            true => settings.max_speed_m_s,
            false => by_rate.max(
                usual.map_or(0.0, |usual| (settings.max_speed_m_s * usual).min(MAX_RATE * by_rate)),
            ),
        };
        let mut habits = Habits { max_speed, turn: settings.turn, jump: settings.jump };
        let Frame { descriptor, is_informative } = frame;
        let novelty = self.seen.novelty(descriptor, ground.difference()).filter(|_| is_informative);
        let fresh = if is_informative { self.seen.add(descriptor, novelty) } else { 0.0 };
        let belief = match (last, step.odometry) {
            (None, _) => Belief::clone(&self.belief),
            (Some(_), Some(odometry)) => {
                self.moved(odometry, elapsed, &mut habits, ground, settings)
            }
            (Some(_), None) => {
                let motion = Motion::Elapsed { time: elapsed, novelty };
                let changes = Changes(ground.changes(self.belief.images()));
                self.belief.predicted(motion, habits, changes.roads(ground))
            }
        };
        let warning = self.rate_warning(step, (max_speed, spacing), settings);
        if let Some(arrived) = arrived {
            let usual = usual.unwrap_or(arrived);
            let next = usual + INTERVAL_WEIGHT * (arrived.min(PAUSE * usual) - usual);
            self.interval = Some(next.max(MIN_INTERVAL_S));
        }
        self.last = Some(Last { captured_at: step.captured_at.or(before), arrived: now });
        self.frames += 1;
        let frame = self.seen.centred(descriptor, ground.mean());
        Prediction { belief, fresh, is_late: false, frame, warning }
    }

    /// The belief after a move by odometry.
    fn moved(
        &mut self,
        odometry: Odometry,
        elapsed: f64,
        habits: &mut Habits,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Belief {
        let moved = self.odometer.add(odometry, settings.odometry_error, ground.paths.spacing());
        if moved.turned {
            habits.turn = TURNED;
        }
        let speed = if elapsed > 0.0 { moved.metres / elapsed } else { 0.0 };
        let motion = Motion::Measured { metres: moved.metres, error: moved.error, speed };
        self.belief.predicted(motion, *habits, Changes::none().roads(ground))
    }

    /// The belief when a frame was taken that is older than the last one.
    fn predict_late(
        &mut self,
        at: Timestamp,
        frame: &[f32],
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Prediction {
        self.frames += 1;
        let max_speed = settings.max_speed_m_s;
        let habits = Habits { max_speed, turn: settings.turn, jump: settings.jump };
        let before = self.kept.iter().rev().find(|(time, _)| *time <= at);
        let belief = before.map_or_else(Belief::uniform, |(time, belief)| {
            let time = at.duration_since(*time).as_secs_f64();
            let motion = Motion::Elapsed { time, novelty: None };
            belief.predicted(motion, habits, Changes::none().roads(ground))
        });
        let frame = self.seen.centred(frame, ground.mean());
        // A recording that is replayed again would be late for ever.
        let warning = before.is_none().then(|| {
            "the frame is older than the last frames of its track, so it was localized alone; if the clock was set back \
             or a recording starts again, use a new track id"
                .to_owned()
        });
        Prediction { belief, fresh: 1.0, is_late: true, frame, warning }
    }

    /// What to tell a robot whose frames have no times and arrive faster than it can have moved.
    fn rate_warning(
        &self,
        step: &TrackStep,
        (max_speed, spacing): (f64, f64),
        settings: &TrackSettings,
    ) -> Option<String> {
        let interval = self.interval.filter(|_| self.frames >= JUDGED)?;
        if step.captured_at.is_some() || step.odometry.is_some() {
            return None;
        }
        let possible = settings.max_speed_m_s * interval / max_speed;
        let image = spacing / max_speed;
        (self.belief.faster_than(possible, image) > SURE).then(|| {
            let speed = self.belief.speed(image) * max_speed / interval;
            format!(
                "the frames of this track arrive as if the robot moved at {speed:.0} m/s, faster than \
                 track.max_speed_m_s = {}; their order was used and not the times of arrival. Send captured_at with \
                 each frame, or moved_m",
                settings.max_speed_m_s
            )
        })
    }

    /// The update step: keeps and returns the belief after a frame. Without `weights`, the frame showed nothing.
    pub fn update(
        &mut self,
        prediction: Prediction,
        weights: Option<&Weights>,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Arc<Belief> {
        let belief = Arc::new(match weights {
            Some(weights) => prediction.belief.updated(weights, ground.len(), settings.states),
            None => prediction.belief,
        });
        if !prediction.is_late {
            self.belief = Arc::clone(&belief);
            if let Some(at) = self.last.and_then(|last| last.captured_at) {
                if self.kept.len() == KEPT {
                    self.kept.pop_front();
                }
                self.kept.push_back((at, Arc::clone(&belief)));
            }
        }
        belief
    }
}

/// How much the images of a belief differ from their neighbours.
struct Changes(Vec<f32>);

impl Changes {
    /// For motions that do not ask.
    fn none() -> Self {
        Self(Vec::new())
    }

    fn roads<'a>(&'a self, ground: &'a Ground) -> Roads<'a> {
        Roads { grid: &ground.grid, paths: &ground.paths, changes: &self.0 }
    }
}

impl Prediction {
    /// The images whose similarity to the frame is needed: those of the belief, the candidates of the search, and the
    /// sample of the map.
    pub fn images(&self, candidates: &[u32], ground: &Ground) -> Vec<u32> {
        let mut images = [self.belief.images(), candidates, ground.sample()].concat();
        images.sort_unstable();
        images.dedup();
        images
    }

    /// The weights of images by their similarity to the frame, without the mean of the track.
    pub fn weights(
        &self,
        (images, similarities): (&[u32], &[Option<f32>]),
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Option<Weights> {
        let shift = whereabouts_core::dot(&self.frame, ground.mean());
        let lengths = ground.lengths(images);
        let known = images.iter().zip(similarities).zip(lengths);
        let similar: Vec<(u32, f32)> = known
            .filter_map(|((image, similarity), length)| {
                Some((*image, ((*similarity)? - shift) / length))
            })
            .collect();
        let is_sample = |image: &u32| ground.sample().binary_search(image).is_ok();
        let sample: Vec<f32> =
            similar.iter().filter(|(image, _)| is_sample(image)).map(|(_, s)| *s).collect();
        let strength = (settings.sharpness * self.fresh, settings.outliers);
        (!sample.is_empty()).then(|| Weights::new(&similar, &sample, ground.len(), strength))
    }
}
