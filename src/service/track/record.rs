//! A track in bytes, for the store: protocol buffers, so that servers of other versions read what they know.
//!
//! Images are named by their slots, which all servers share, and times by how long ago they were, since servers differ
//! in their clocks. Probabilities below [`TRACE`] are left out, and numbers of descriptors have 16 bits. What is kept of
//! earlier frames is left out, the oldest first, where a track would be larger than `track.state_bytes`.

mod messages;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use jiff::Timestamp;
use prost::Message;
use tokio::time::Instant;

use self::messages::{
    ClockRecord, FramesRecord, KeptRecord, OdometerRecord, OlderRecord, PassedRecord,
    PosteriorRecord, ReadingRecord, StepRecord, TrackRecord, VectorRecord,
};
use super::belief::Belief;
use super::clock::{Clock, Older, Reading};
use super::evidence::Frames;
use super::ground::Ground;
use super::history::{Move, Passed};
use super::moves::Motion;
use super::odometry::Odometer;
use super::posterior::Posterior;
use super::presence::{LEVELS, Presence};
use super::session::{Step, Track};
use super::speeds::STATES;

/// Probabilities of states below this are not stored.
const TRACE: f32 = 1e-6;

/// Number of images that are stored of a belief for late frames.
const KEPT_IMAGES: usize = 64;

impl Track {
    /// The track in at most `most` bytes; `None` if it does not fit.
    pub fn to_bytes(&self, ground: &Ground, most: usize) -> Option<Bytes> {
        let now = Instant::now();
        let mut record = TrackRecord {
            states: STATES as u32,
            revision: self.revision,
            frames: self.frames,
            last_frame_us: self.last_frame_at.as_microsecond(),
            posterior: Some(posterior_record(&self.posterior, ground, usize::MAX)),
            seen: Some(frames_record(&self.seen, &self.centred)),
            odometer: Some(OdometerRecord {
                pending: self.odometer.pending,
                error: self.odometer.error,
                turn: self.odometer.turn,
                backwards: self.odometer.backwards,
            }),
            clock: Some(clock_record(&self.clock, now)),
            passed: self.passed.iter().map(|passed| passed_record(passed, ground)).collect(),
            kept: self.kept.iter().map(|kept| kept_record(kept, ground)).collect(),
            steps: self.steps.iter().map(step_record).collect(),
        };
        while record.encoded_len() > most {
            let oldest = record.passed.len().div_ceil(2);
            if oldest > 0 {
                record.passed.drain(..oldest);
            } else if !record.kept.is_empty() {
                record.kept.clear();
            } else {
                return None;
            }
        }
        Some(record.encode_to_vec().into())
    }

    /// Reads a track that was stored `age` ago; `None` if another filter wrote it.
    pub fn from_bytes(bytes: &Bytes, age: Duration, ground: &Arc<Ground>) -> Option<Self> {
        let record = TrackRecord::decode(bytes.clone()).ok()?;
        if record.states != STATES as u32 {
            return None;
        }
        let stored = Stored { ground, at: ago(Instant::now(), age.as_secs_f64()) };
        let (seen, centred) = frames(record.seen?);
        let odometer = record.odometer.unwrap_or_default();
        Some(Self {
            posterior: Arc::new(stored.posterior(record.posterior?)),
            ground: Some(Arc::clone(ground)),
            revision: record.revision,
            frames: record.frames,
            last_frame_at: moment(record.last_frame_us),
            seen,
            centred,
            odometer: Odometer {
                pending: odometer.pending,
                error: odometer.error,
                turn: odometer.turn,
                backwards: odometer.backwards,
            },
            clock: stored.clock(record.clock.unwrap_or_default()),
            passed: record.passed.into_iter().map(|passed| stored.passed(passed)).collect(),
            kept: record.kept.into_iter().filter_map(|kept| stored.kept(kept)).collect(),
            steps: record.steps.iter().map(step).collect(),
        })
    }
}

/// What the records of a track refer to.
struct Stored<'a> {
    ground: &'a Ground,
    /// When it was stored.
    at: Instant,
}

impl Stored<'_> {
    /// Images that this server does not know yet, or that are gone, are spread over the map.
    fn posterior(&self, record: PosteriorRecord) -> Posterior {
        let (mut images, mut states) = (Vec::new(), Vec::new());
        let mut all = record.states.iter().zip(&record.masses);
        for (slot, count) in record.slots.iter().zip(&record.counts) {
            let mut of_image = [0.0; STATES];
            for (state, mass) in all.by_ref().take(*count as usize) {
                if let Some(sum) = of_image.get_mut(usize::from(*state)) {
                    *sum = if mass.is_finite() { mass.max(0.0) } else { 0.0 };
                }
            }
            if let Some(image) = self.ground.in_slot(*slot as usize) {
                images.push(image);
                states.push(of_image);
            }
        }
        let levels = |levels: &[f64]| -> [f64; LEVELS] {
            std::array::from_fn(|at| levels.get(at).copied().unwrap_or_default().max(0.0))
        };
        let (on, off) = (levels(&record.on), levels(&record.off));
        Posterior {
            belief: Belief::with_rest(images, states),
            presence: Presence { on, off }.normalised(),
        }
    }

    fn clock(&self, record: ClockRecord) -> Clock {
        let reading = |last: ReadingRecord| Reading {
            captured_at: last.captured_us.map(moment),
            arrived: ago(self.at, last.arrived_s),
        };
        let older = |older: OlderRecord| Older {
            first: moment(older.first_us),
            newest: moment(older.newest_us),
            arrived: ago(self.at, older.arrived_s),
            count: older.count,
        };
        Clock {
            last: record.last.map(reading),
            before_step: record.before_step_us.map(moment),
            older: record.older.map(older),
            arrivals: record.arrivals,
            captures: record.captures,
            timed: record.timed,
            same: record.same,
        }
    }

    fn passed(&self, record: PassedRecord) -> Passed {
        let images = record.slots.iter().zip(&record.masses);
        let images: Vec<(u32, f32)> = images
            .filter_map(|(slot, mass)| Some((self.ground.in_slot(*slot as usize)?, *mass)))
            .collect();
        let known: f64 = images.iter().map(|(_, mass)| f64::from(*mass)).sum();
        Passed {
            captured_at: record.captured_us.map(moment),
            received_at: moment(record.received_us),
            images,
            elsewhere: (1.0 - record.off_map - known).max(0.0),
            off_map: record.off_map,
            moved: record.metres.map(|metres| Move { metres, error: record.error }),
        }
    }

    fn kept(&self, record: KeptRecord) -> Option<(Timestamp, Arc<Posterior>)> {
        Some((moment(record.captured_us), Arc::new(self.posterior(record.posterior?))))
    }
}

/// What is stored of a posterior: of the `most` likely images.
fn posterior_record(posterior: &Posterior, ground: &Ground, most: usize) -> PosteriorRecord {
    let Posterior { belief, presence } = posterior;
    let mut record = PosteriorRecord {
        on: presence.on.to_vec(),
        off: presence.off.to_vec(),
        ..PosteriorRecord::default()
    };
    let least = least_of(belief, most);
    for ((image, mass), states) in belief.masses().into_iter().zip(&belief.states) {
        if mass < least {
            continue;
        }
        let before = record.states.len();
        for (state, mass) in (0..).zip(states).filter(|(_, mass)| **mass >= TRACE) {
            record.states.push(state);
            record.masses.push(*mass);
        }
        record.slots.push(ground.slot(image) as u64);
        record.counts.push((record.states.len() - before) as u32);
    }
    record
}

/// The probability of the last of the `most` likely images.
fn least_of(belief: &Belief, most: usize) -> f64 {
    let mut masses: Vec<f64> = belief.masses().into_iter().map(|(_, mass)| mass).collect();
    if masses.len() <= most {
        return 0.0;
    }
    *masses.select_nth_unstable_by(most, |a, b| b.total_cmp(a)).1
}

fn frames_record(seen: &Frames, centred: &[f32]) -> FramesRecord {
    FramesRecord {
        sum: Some(vector_record(&seen.sum)),
        weight: seen.weight,
        last: seen.last.iter().map(|last| vector_record(last)).collect(),
        repeated: seen.repeated,
        alternation: seen.alternation,
        count: seen.count,
        centred: Some(vector_record(centred)),
    }
}

fn frames(record: FramesRecord) -> (Frames, Vec<f32>) {
    let frames = Frames {
        sum: vector(&record.sum.unwrap_or_default()),
        weight: record.weight,
        last: record.last.iter().map(vector).collect(),
        repeated: record.repeated,
        alternation: record.alternation,
        count: record.count,
    };
    (frames, vector(&record.centred.unwrap_or_default()))
}

fn vector_record(numbers: &[f32]) -> VectorRecord {
    let scale = numbers.iter().fold(0.0_f32, |most, number| most.max(number.abs()));
    let step = f32::from(i16::MAX) / scale.max(f32::MIN_POSITIVE);
    let numbers = numbers.iter().flat_map(|number| ((number * step).round() as i16).to_le_bytes());
    VectorRecord { scale, numbers: numbers.collect() }
}

fn vector(record: &VectorRecord) -> Vec<f32> {
    let step = record.scale / f32::from(i16::MAX);
    let (numbers, _) = record.numbers.as_chunks::<2>();
    numbers.iter().map(|number| f32::from(i16::from_le_bytes(*number)) * step).collect()
}

fn clock_record(clock: &Clock, now: Instant) -> ClockRecord {
    let since = |at: Instant| now.duration_since(at).as_secs_f64();
    ClockRecord {
        last: clock.last.map(|last| ReadingRecord {
            captured_us: last.captured_at.map(Timestamp::as_microsecond),
            arrived_s: since(last.arrived),
        }),
        before_step_us: clock.before_step.map(Timestamp::as_microsecond),
        older: clock.older.map(|older| OlderRecord {
            first_us: older.first.as_microsecond(),
            newest_us: older.newest.as_microsecond(),
            arrived_s: since(older.arrived),
            count: older.count,
        }),
        arrivals: clock.arrivals,
        captures: clock.captures,
        timed: clock.timed,
        same: clock.same,
    }
}

fn passed_record(passed: &Passed, ground: &Ground) -> PassedRecord {
    PassedRecord {
        captured_us: passed.captured_at.map(Timestamp::as_microsecond),
        received_us: passed.received_at.as_microsecond(),
        slots: passed.images.iter().map(|(image, _)| ground.slot(*image) as u64).collect(),
        masses: passed.images.iter().map(|(_, mass)| *mass).collect(),
        off_map: passed.off_map,
        metres: passed.moved.map(|moved| moved.metres),
        error: passed.moved.map(|moved| moved.error).unwrap_or_default(),
    }
}

fn kept_record((at, posterior): &(Timestamp, Arc<Posterior>), ground: &Ground) -> KeptRecord {
    KeptRecord {
        captured_us: at.as_microsecond(),
        posterior: Some(posterior_record(posterior, ground, KEPT_IMAGES)),
    }
}

fn step_record(step: &Step) -> StepRecord {
    let record =
        StepRecord { frame: step.frame, max_speed: step.max_speed, ..StepRecord::default() };
    match step.motion {
        Some(Motion::Measured { metres, error, speed }) => {
            StepRecord { metres: Some(metres), error, speed, ..record }
        }
        Some(Motion::Elapsed { time, novelty }) => {
            StepRecord { time: Some(time), novelty, ..record }
        }
        None => record,
    }
}

fn step(record: &StepRecord) -> Step {
    let StepRecord { frame, max_speed, error, speed, novelty, .. } = *record;
    let motion = match (record.metres, record.time) {
        (Some(metres), _) => Some(Motion::Measured { metres, error, speed }),
        (None, Some(time)) => Some(Motion::Elapsed { time, novelty }),
        (None, None) => None,
    };
    Step { frame, motion, max_speed }
}

fn moment(microseconds: i64) -> Timestamp {
    Timestamp::from_microsecond(microseconds).unwrap_or(Timestamp::UNIX_EPOCH)
}

/// A moment so many seconds before another; that one if the clock of this machine does not reach back so far.
fn ago(from: Instant, seconds: f64) -> Instant {
    let before = Duration::try_from_secs_f64(seconds.max(0.0)).ok();
    before.and_then(|before| from.checked_sub(before)).unwrap_or(from)
}

#[cfg(test)]
mod tests;
