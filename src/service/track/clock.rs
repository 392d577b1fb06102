//! How much time has passed between two frames, by the clock of a robot, which may be wrong.
//!
//! Only differences of times matter, so a clock that is wrong all the time does no harm. One that is *set* while the
//! robot drives does: after a step ahead, the robot seems to have had hours to move, and after a step back, every frame
//! seems to be old. Neither may stop a track. Frames that arrive out of order and recordings that are replayed at any
//! speed look alike at first, so that the clock waits for the frames that follow.

use jiff::{SignedDuration, Timestamp};
use tokio::time::Instant;

/// A pause of this many times the usual interval of frames without times is a pause, and not jitter.
const PAUSE: f64 = 3.0;

/// Weight of a new interval in the usual one.
const INTERVAL_WEIGHT: f64 = 0.2;

/// Shortest interval of frames in seconds.
const MIN_INTERVAL_S: f64 = 1e-4;

/// Longest time between two frames that limits how far a robot may have moved.
const MAX_PAUSE_S: f64 = 86_400.0;

/// A time that is this much ahead of the server's is the fault of a clock, in seconds.
const AHEAD_S: f64 = 10.0;

/// A step ahead of more than this many seconds may be that of a clock which was set ...
const STEP_S: f64 = 45.0;

/// ... if it is also this many times the usual one: robots that are recorded wait, and drive where nothing is recorded ...
const STEP: f64 = 25.0;

/// ... and this many times what the frame took to arrive.
const STEP_ARRIVED: f64 = 10.0;

/// This many frames in a row that are older than the last, in order and at the usual pace, follow a clock that was set
/// back.
const SET_BACK: u32 = 3;

/// Frames that arrive in less than this share of the usual interval are sent late, all together.
const BURST: f64 = 0.3;

/// Number of frames after which the unit and the progress of a clock are judged.
const JUDGED: u64 = 5;

/// A clock this many times faster or slower than the server's has another unit, if frames do not arrive as fast as they
/// can be sent: no recording is replayed like that.
const OTHER_UNIT: f64 = 500.0;

/// Frames that are sent as fast as they can be arrive more often than this, in seconds.
const REPLAYED_S: f64 = 0.2;

/// The longest first interval that says what is usual, in seconds.
const MAX_FIRST_S: f64 = 60.0;

/// Number of frames with the same time after which a clock has stopped; it may have a resolution of seconds.
const STOPPED: u32 = 40;

/// The clock of a robot, as its frames show it.
#[derive(Debug, Clone, Default)]
pub(super) struct Clock {
    pub last: Option<Reading>,
    /// The frame before the clock went ahead by an unusual step, until the next frame.
    pub before_step: Option<Timestamp>,
    /// Frames in a row that are older than the last.
    pub older: Option<Older>,
    /// The usual time between two arrivals in seconds.
    pub arrivals: Option<f64>,
    /// The usual time between two frames by the robot's clock, in seconds.
    pub captures: Option<f64>,
    /// Number of frames with both times.
    pub timed: u64,
    /// Frames in a row with the same time.
    pub same: u32,
}

/// The frame before.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reading {
    pub captured_at: Option<Timestamp>,
    pub arrived: Instant,
}

/// Frames in a row that are older than the last one of a track.
#[derive(Debug, Clone, Copy)]
pub(super) struct Older {
    pub first: Timestamp,
    pub newest: Timestamp,
    pub arrived: Instant,
    pub count: u32,
}

/// What the clock says about a frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Tick {
    /// It is the first.
    First,
    /// It follows the last one.
    Next {
        /// The time since then.
        elapsed: Elapsed,
        /// The time that may have passed instead, if the clock was set.
        or_else: Option<Elapsed>,
        /// Whether times before this one are those of another clock.
        is_reset: bool,
    },
    /// It is older than the last one.
    Late(Timestamp),
}

/// The time between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Elapsed {
    Seconds(f64),
    /// In units of the usual interval of the frames.
    Intervals(f64),
}

impl Elapsed {
    /// The number, in the unit of the speeds.
    pub fn number(self) -> f64 {
        match self {
            Self::Seconds(number) | Self::Intervals(number) => number,
        }
    }
}

/// What the server knows about the arrival of a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arrival {
    pub at: Instant,
    /// The time of day.
    pub clock: Timestamp,
}

impl Clock {
    /// The usual time between two arrivals in seconds.
    pub fn usual_arrival(&self) -> Option<f64> {
        self.arrivals
    }

    /// When the last frame was taken.
    pub fn last_capture(&self) -> Option<Timestamp> {
        self.last?.captured_at
    }

    /// Reads the time of a frame. Returns also what the robot should do about its clock.
    pub fn read(
        &mut self,
        captured_at: Option<Timestamp>,
        arrival: Arrival,
    ) -> (Tick, Option<String>) {
        let Some(last) = self.last else {
            self.last = Some(Reading { captured_at, arrived: arrival.at });
            return (Tick::First, captured_at.and_then(|at| wrong_clock(at, arrival.clock, true)));
        };
        let arrived = arrival.at.duration_since(last.arrived).as_secs_f64();
        let (tick, warning) = match captured_at.zip(last.captured_at) {
            Some((at, before)) => self.timed(at, before, arrived, arrival),
            None => (self.by_arrival(arrived), None),
        };
        if !matches!(tick, Tick::Late(_)) {
            let captured_at = captured_at.or(last.captured_at);
            self.last = Some(Reading { captured_at, arrived: arrival.at });
            self.older = None;
            let usual = self.arrivals.unwrap_or(arrived);
            self.arrivals = Some(usual_with(usual, arrived.min(PAUSE * usual)));
        }
        let wrong = || captured_at.and_then(|at| wrong_clock(at, arrival.clock, false));
        (tick, warning.or_else(wrong))
    }

    /// The tick of a frame without a time: the frames' own rate is more than their arrival can tell.
    fn by_arrival(&self, arrived: f64) -> Tick {
        let pause = arrived / self.arrivals.unwrap_or(arrived).max(MIN_INTERVAL_S);
        next(Elapsed::Intervals(if pause > PAUSE { pause } else { 1.0 }))
    }

    fn timed(
        &mut self,
        at: Timestamp,
        before: Timestamp,
        arrived: f64,
        arrival: Arrival,
    ) -> (Tick, Option<String>) {
        let before_step = self.before_step.take();
        let elapsed = seconds(before, at);
        if elapsed < 0.0 {
            return self.older(at, before, before_step, arrival);
        }
        self.timed += 1;
        self.same = if elapsed > 0.0 { 0 } else { self.same + 1 };
        if self.same >= STOPPED {
            return (self.by_arrival(arrived), Some(stopped()));
        }
        let usual = self.captures;
        let is_step = is_step(elapsed, usual, arrived);
        if is_step && before_step.is_none() {
            self.before_step = Some(before);
            let or_else = Some(Elapsed::Seconds(self.usual_capture(arrived)));
            let elapsed = Elapsed::Seconds(elapsed.min(MAX_PAUSE_S));
            let warning = stepped(seconds(before, at), arrived);
            return (Tick::Next { elapsed, or_else, is_reset: false }, Some(warning));
        }
        // Two in a row are no steps.
        let next_usual = match usual {
            Some(usual) if !is_step => usual,
            Some(_) => elapsed,
            None => elapsed.min(MAX_FIRST_S),
        };
        self.captures = Some(usual_with(next_usual, elapsed.min(PAUSE * next_usual.max(1.0))));
        if let Some(ratio) = self.ratio().filter(|_| self.timed >= JUDGED)
            && self.arrivals.is_some_and(|arrivals| arrivals >= REPLAYED_S)
            && !(1.0 / OTHER_UNIT..=OTHER_UNIT).contains(&ratio)
            && elapsed > 0.0
        {
            return (self.by_arrival(arrived), Some(other_unit(ratio)));
        }
        (next(Elapsed::Seconds(elapsed.min(MAX_PAUSE_S))), None)
    }

    /// The tick of a frame that is older than the last.
    fn older(
        &mut self,
        at: Timestamp,
        before: Timestamp,
        before_step: Option<Timestamp>,
        arrival: Arrival,
    ) -> (Tick, Option<String>) {
        let usual = self.captures.unwrap_or(1.0);
        // One frame had a wrong time: its step ahead was none.
        if let Some(start) = before_step.filter(|start| *start <= at) {
            let elapsed = (seconds(start, at) - usual).max(0.0);
            return (reset(Elapsed::Seconds(elapsed.min(MAX_PAUSE_S))), Some(set_back(before, at)));
        }
        // The clock was ahead, and is right now.
        let off = seconds(arrival.clock, at).abs();
        if off < AHEAD_S && seconds(arrival.clock, before) > AHEAD_S {
            return (reset(Elapsed::Seconds(usual)), Some(set_back(before, at)));
        }
        let is_at_pace = |since: Instant| {
            let arrived = arrival.at.duration_since(since).as_secs_f64();
            self.arrivals.is_none_or(|usual| arrived >= BURST * usual)
        };
        let following = self.older.filter(|older| at > older.newest && is_at_pace(older.arrived));
        let older = match following {
            Some(older) => {
                Older { newest: at, arrived: arrival.at, count: older.count + 1, ..older }
            }
            None => Older { first: at, newest: at, arrived: arrival.at, count: 1 },
        };
        if older.count >= SET_BACK {
            let elapsed = seconds(older.first, at) + usual;
            return (reset(Elapsed::Seconds(elapsed.min(MAX_PAUSE_S))), Some(set_back(before, at)));
        }
        self.older = Some(older);
        (Tick::Late(at), None)
    }

    /// The time that a frame usually follows the one before, given how long it took to arrive.
    fn usual_capture(&self, arrived: f64) -> f64 {
        match self.captures.zip(self.arrivals) {
            // In real time, the arrival says more.
            Some((captures, arrivals)) if arrivals > captures / PAUSE => arrived.min(MAX_PAUSE_S),
            Some((captures, _)) => captures,
            None => arrived.min(MAX_PAUSE_S),
        }
    }

    /// How much faster the robot's clock runs than the server's.
    fn ratio(&self) -> Option<f64> {
        Some(self.captures? / self.arrivals?.max(MIN_INTERVAL_S))
    }
}

fn next(elapsed: Elapsed) -> Tick {
    Tick::Next { elapsed, or_else: None, is_reset: false }
}

/// The tick of the first frame by another clock.
fn reset(elapsed: Elapsed) -> Tick {
    Tick::Next { elapsed, or_else: None, is_reset: true }
}

/// Whether a clock that went ahead by this much may have been set.
fn is_step(elapsed: f64, usual: Option<f64>, arrived: f64) -> bool {
    elapsed > STEP_S
        && elapsed > STEP_ARRIVED * arrived
        && usual.is_some_and(|usual| elapsed > STEP * usual)
}

fn usual_with(usual: f64, new: f64) -> f64 {
    (usual + INTERVAL_WEIGHT * (new - usual)).max(MIN_INTERVAL_S)
}

fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    to.duration_since(from).as_secs_f64()
}

/// A time span as people write it.
fn span(seconds: f64) -> String {
    let rounded = SignedDuration::try_from_secs_f64(seconds.abs().round()).unwrap_or_default();
    format!("{rounded:#}")
}

/// What to do about a clock that shows a time that cannot be.
fn wrong_clock(at: Timestamp, now: Timestamp, is_first: bool) -> Option<String> {
    let ahead = seconds(now, at);
    if ahead > AHEAD_S {
        return Some(format!(
            "captured_at is {} ahead of this server's clock. The track goes by the differences of times, so it is \
             followed all the same; set the robot's clock, for example with NTP, before it drives",
            span(ahead)
        ));
    }
    // 2000-01-01.
    (is_first && at.as_second() < 946_684_800).then(|| {
        format!(
            "captured_at is {at}: that is no date, or that of a clock that was not set. The track goes by the \
             differences of times, so it is followed all the same, as long as all its frames have the same clock; a \
             clock that is set later costs it some frames"
        )
    })
}

fn stepped(elapsed: f64, arrived: f64) -> String {
    format!(
        "captured_at is {} after that of the frame before, which arrived {} ago. If the robot's clock was set, the track \
         is sure again after some frames; let NTP slew the clock while the robot drives, or start a new track id",
        span(elapsed),
        span(arrived)
    )
}

fn set_back(before: Timestamp, at: Timestamp) -> String {
    format!(
        "captured_at is {} before that of an earlier frame: the robot's clock was set back, or a recording starts again. \
         The track goes on by the new times; let NTP slew the clock while the robot drives, and give a recording that \
         starts again a new track id",
        span(seconds(at, before))
    )
}

fn stopped() -> String {
    format!(
        "captured_at has been the same for {STOPPED} frames, so the order of the frames is used and not their times; \
         send when each frame was taken, or leave captured_at out"
    )
}

fn other_unit(ratio: f64) -> String {
    let (how, factor) = if ratio > 1.0 { ("faster", ratio) } else { ("slower", 1.0 / ratio) };
    format!(
        "captured_at advances {factor:.0} times {how} than frames arrive, so the order of the frames is used and not \
         their times; send seconds since 1970, or a time as in RFC 3339"
    )
}

#[cfg(test)]
mod tests;
