//! One track: what the filter knows of a robot, and the steps that change it.

use std::collections::VecDeque;
use std::sync::Arc;

use jiff::Timestamp;
use tokio::time::Instant;

use super::belief::Habits;
use super::clock::{Arrival, Clock, Elapsed, Tick};
use super::evidence::Frames;
use super::ground::Ground;
use super::history::Passed;
use super::moves::Motion;
use super::odometry::{Odometer, Odometry};
use super::posterior::{FrameWeights, Posterior};
use super::prediction::{Changes, Prediction, unlike};
use super::verdicts::VERDICT_STEPS;
use super::{TrackSettings, TrackStep};

/// Number of beliefs kept for frames that arrive late.
const KEPT: usize = 8;

/// A robot whose frames have no times moves at most this far from one to the next, in units of the usual distance of
/// neighbours in the map.
const MAX_RATE: f64 = 8.0;

/// Number of frames after which the rate of frames without times is judged.
const JUDGED: u64 = 5;

/// Probability from which on a robot without times is told that it is too fast.
const SURE: f64 = 0.9;

/// Probability that a robot which turned by more than two right angles, or reversed, now moves the other way on its
/// path.
const TURNED: f64 = 0.8;

/// What to tell robots that share a track.
const SHARED: &str = "the frames of this track alternate between two views, as if two robots or cameras shared its id; \
                      each was localized alone. Give each camera a track id of its own";

/// The state of a track between two frames.
#[derive(Debug, Clone)]
pub(super) struct Track {
    pub posterior: Arc<Posterior>,
    /// The map that it refers to.
    pub ground: Option<Arc<Ground>>,
    /// The revision of that map: descriptors of another one cannot be compared.
    pub revision: u32,
    pub frames: u64,
    /// When the last frame arrived.
    pub last_frame_at: Timestamp,
    pub seen: Frames,
    /// The last frame without what it has in common with others; empty before the first.
    pub centred: Vec<f32>,
    pub odometer: Odometer,
    pub clock: Clock,
    /// What the filter said after the last frames, the oldest first.
    pub passed: VecDeque<Passed>,
    /// The latest posteriors, with the times that their robot stated.
    pub kept: VecDeque<(Timestamp, Arc<Posterior>)>,
    /// The last frames, each with how the robot had moved since the one before, the oldest first.
    pub steps: VecDeque<Step>,
}

/// How a robot had moved when a frame was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Step {
    /// The number of the frame in its track.
    pub frame: u64,
    /// `None` if that is not known.
    pub motion: Option<Motion>,
    /// The highest speed that is possible, in metres per unit of time.
    pub max_speed: f64,
}

/// A frame, as the filter takes it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame<'a> {
    pub descriptor: &'a [f32],
    /// Whether it shows anything.
    pub is_informative: bool,
}

impl Track {
    /// A track without frames.
    pub fn new() -> Self {
        Self {
            posterior: Arc::new(Posterior::new()),
            ground: None,
            revision: 0,
            frames: 0,
            centred: Vec::new(),
            last_frame_at: Timestamp::UNIX_EPOCH,
            seen: Frames::default(),
            odometer: Odometer::default(),
            clock: Clock::default(),
            passed: VecDeque::new(),
            kept: VecDeque::new(),
            steps: VecDeque::new(),
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
            self.posterior = Arc::new(self.posterior.renumbered(&number));
            for (_, posterior) in &mut self.kept {
                *posterior = Arc::new(posterior.renumbered(&number));
            }
            self.passed.iter_mut().for_each(|passed| passed.renumber(&number));
        }
        self.ground = Some(Arc::clone(ground));
    }

    /// The prediction step: what is believed when a frame is taken. `frame` is its descriptor.
    pub fn predict(
        &mut self,
        step: &TrackStep,
        frame: Frame,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Prediction {
        let usual = self.clock.usual_arrival();
        let arrival = Arrival { at: Instant::now(), clock: Timestamp::now() };
        self.last_frame_at = arrival.clock;
        let (tick, clock_warning) = self.clock.read(step.captured_at, arrival);
        let spans = match tick {
            Tick::Late(at) => return self.predict_late(at, frame.descriptor, ground, settings),
            Tick::First => None,
            Tick::Next { elapsed, or_else, is_reset } => {
                if is_reset {
                    self.kept.clear();
                }
                Some((elapsed, or_else))
            }
        };
        let spacing = ground.paths.spacing();
        // The frames' own rate is more than the clock can tell.
        let by_rate = MAX_RATE * spacing;
        let max_speed = match spans {
            Some((Elapsed::Seconds(_), _)) => settings.max_speed_m_s,
            _ => by_rate.max(
                usual.map_or(0.0, |usual| (settings.max_speed_m_s * usual).min(MAX_RATE * by_rate)),
            ),
        };
        let habits = habits(max_speed, settings);
        let Frame { descriptor, is_informative } = frame;
        let novelty = self.seen.novelty(descriptor, ground.difference()).filter(|_| is_informative);
        let fresh = if is_informative {
            self.seen.add(descriptor, novelty, ground.difference())
        } else {
            0.0
        };
        let (posterior, motion) = match (spans, step.odometry) {
            // What one of two robots sees says nothing of the other.
            _ if self.seen.alternates() => (Posterior::new(), None),
            (None, _) => (Posterior::clone(&self.posterior), None),
            (Some((elapsed, or_else)), Some(odometry)) => {
                let elapsed = or_else.unwrap_or(elapsed).number();
                let (posterior, motion) = self.moved(odometry, elapsed, habits, ground, settings);
                (posterior, Some(motion))
            }
            (Some((elapsed, or_else)), None) => {
                let changes = Changes(ground.changes(self.posterior.belief.images()));
                let motion = |elapsed: Elapsed| Motion::Elapsed { time: elapsed.number(), novelty };
                let after = |elapsed: Elapsed| {
                    self.posterior.predicted(motion(elapsed), habits, changes.roads(ground))
                };
                match or_else {
                    // The frames that follow decide.
                    Some(other) => (after(elapsed).mixed(&after(other), ground.len()), None),
                    None => (after(elapsed), Some(motion(elapsed))),
                }
            }
        };
        let shared = self.seen.alternates().then(|| SHARED.to_owned());
        let warning = shared
            .or(clock_warning)
            .or_else(|| self.rate_warning(step, (max_speed, spacing), settings));
        self.frames += 1;
        let frame = self.seen.centred(descriptor, ground.mean());
        let unlike = unlike(&self.centred, &frame);
        if is_informative {
            self.centred.clone_from(&frame);
        }
        let times = (step.captured_at, arrival.clock);
        Prediction {
            posterior,
            fresh,
            is_late: false,
            unlike,
            frame,
            warning,
            times,
            motion,
            max_speed,
        }
    }

    /// What is believed after a move by odometry.
    fn moved(
        &mut self,
        odometry: Odometry,
        elapsed: f64,
        mut habits: Habits,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> (Posterior, Motion) {
        let moved = self.odometer.add(odometry, settings.odometry_error, ground.paths.spacing());
        if moved.turned {
            habits.turn = TURNED;
        }
        let speed = if elapsed > 0.0 { moved.metres / elapsed } else { 0.0 };
        let motion = Motion::Measured { metres: moved.metres, error: moved.error, speed };
        (self.posterior.predicted(motion, habits, Changes::none().roads(ground)), motion)
    }

    /// What is believed when a frame was taken that is older than the last one.
    fn predict_late(
        &mut self,
        at: Timestamp,
        frame: &[f32],
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Prediction {
        self.frames += 1;
        let habits = habits(settings.max_speed_m_s, settings);
        let before = self.kept.iter().rev().find(|(time, _)| *time <= at);
        let posterior = before.map_or_else(Posterior::new, |(time, posterior)| {
            let time = at.duration_since(*time).as_secs_f64();
            let motion = Motion::Elapsed { time, novelty: None };
            posterior.predicted(motion, habits, Changes::none().roads(ground))
        });
        let frame = self.seen.centred(frame, ground.mean());
        // A recording that is replayed again would be late for ever.
        let warning = before.is_none().then(|| {
            "the frame is older than the last frames of its track, so it was localized alone; if a recording starts \
             again, use a new track id, and give each robot a track id of its own"
                .to_owned()
        });
        let (times, motion) = ((Some(at), Timestamp::now()), None);
        let max_speed = settings.max_speed_m_s;
        Prediction {
            posterior,
            fresh: 1.0,
            is_late: true,
            unlike: 1.0,
            frame,
            warning,
            times,
            motion,
            max_speed,
        }
    }

    /// What to tell a robot whose frames have no times and arrive faster than it can have moved.
    fn rate_warning(
        &self,
        step: &TrackStep,
        (max_speed, spacing): (f64, f64),
        settings: &TrackSettings,
    ) -> Option<String> {
        let interval = self.clock.usual_arrival().filter(|_| self.frames >= JUDGED)?;
        if step.captured_at.is_some() || step.odometry.is_some() {
            return None;
        }
        let possible = settings.max_speed_m_s * interval / max_speed;
        let image = spacing / max_speed;
        let belief = &self.posterior.belief;
        (belief.faster_than(possible, image) > SURE).then(|| {
            let speed = belief.speed(image) * max_speed / interval;
            format!(
                "the frames of this track arrive as if the robot moved at {speed:.0} m/s, faster than \
                 track.max_speed_m_s = {}; their order was used and not the times of arrival. Send captured_at with \
                 each frame, or moved_m",
                settings.max_speed_m_s
            )
        })
    }

    /// The update step: keeps and returns what is believed after a frame. Without `weights`, the frame showed nothing.
    pub fn update(
        &mut self,
        prediction: Prediction,
        weights: Option<&FrameWeights>,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Arc<Posterior> {
        let (times, motion, max_speed) =
            (prediction.times, prediction.motion, prediction.max_speed);
        let posterior = Arc::new(match weights {
            Some(weights) => prediction.posterior.updated(weights, ground.len(), settings.states),
            None => prediction.posterior,
        });
        if !prediction.is_late {
            self.posterior = Arc::clone(&posterior);
            let moved = motion.map(|motion| posterior.moved(motion, max_speed, ground));
            if self.steps.len() == VERDICT_STEPS {
                self.steps.pop_front();
            }
            self.steps.push_back(Step { frame: self.frames, motion, max_speed });
            if self.passed.len() >= settings.history {
                self.passed.pop_front();
            }
            if settings.history > 0 {
                self.passed.push_back(Passed::new(times, &posterior, moved));
            }
            if let Some(at) = self.clock.last_capture() {
                if self.kept.len() == KEPT {
                    self.kept.pop_front();
                }
                self.kept.push_back((at, Arc::clone(&posterior)));
            }
        }
        posterior
    }
}

pub(super) fn habits(max_speed: f64, settings: &TrackSettings) -> Habits {
    let TrackSettings { turn, jump, leave, enter, .. } = *settings;
    Habits { max_speed, turn, jump, leave, enter }
}
