//! The last hour, minute by minute, and the last warnings and errors: what an operator looks at first.

use std::collections::VecDeque;
use std::fmt::{self, Write as _};
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::{Mutex, MutexGuard};
use serde::Serialize;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;
use utoipa::ToSchema;

/// Minutes that are kept.
const MINUTES: usize = 60;

/// Kinds of troubles that are kept.
const TROUBLES: usize = 50;

/// The longest text of a trouble, in bytes.
const LONGEST: usize = 500;

/// Times of answers are counted in steps of 2^(1/8) from half a millisecond on, to about a minute.
const STEPS_AN_OCTAVE: f64 = 8.0;
const STEPS: usize = 136;
const SHORTEST_MS: f64 = 0.5;

/// What was done in one minute.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct Minute {
    /// When it began.
    pub at: Timestamp,
    /// Requests answered.
    pub requests: u64,
    /// Of these, those that the server could not do: 429 and 5xx.
    pub errors: u64,
    /// Frames localized.
    pub frames: u64,
    /// The median time of the answers to these, in milliseconds, to within 5 %.
    pub p50_ms: Option<f64>,
    /// The 95th percentile.
    pub p95_ms: Option<f64>,
    /// The longest.
    pub max_ms: Option<f64>,
    /// Jobs that ended.
    pub jobs_ended: u64,
    /// Of these, those that failed.
    pub jobs_failed: u64,
}

/// Something that the log warned of, or an error in it.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
#[schema(as = Trouble)]
pub struct LogIssue {
    /// When it last happened.
    pub at: Timestamp,
    /// Which part of the server said so.
    #[serde(rename = "where")]
    pub place: String,
    /// What it said.
    pub detail: String,
    /// How often it has said so.
    pub count: u64,
}

/// The last hour. Minutes in which nothing was done are left out.
#[derive(Debug, Default)]
pub struct HourlyStats(Mutex<VecDeque<Counts>>);

#[derive(Debug)]
struct Counts {
    /// Minutes since 1970.
    minute: i64,
    requests: u64,
    errors: u64,
    jobs_ended: u64,
    jobs_failed: u64,
    /// Frames by the time of their answers.
    times: [u32; STEPS],
    longest_ms: f64,
}

impl Counts {
    fn new(minute: i64) -> Self {
        Self {
            minute,
            requests: 0,
            errors: 0,
            jobs_ended: 0,
            jobs_failed: 0,
            times: [0; STEPS],
            longest_ms: 0.0,
        }
    }

    fn told(&self) -> Minute {
        let frames: u64 = self.times.iter().map(|&count| u64::from(count)).sum();
        let quantile = |share: f64| {
            let rank = (share * frames as f64).ceil().max(1.0) as u64;
            let mut below = 0;
            let step = self.times.iter().position(|&count| {
                below += u64::from(count);
                below >= rank
            })?;
            // The middle of the step, on the scale on which the steps are even.
            let middle = SHORTEST_MS * ((step as f64 + 0.5) / STEPS_AN_OCTAVE).exp2();
            Some(middle.min(self.longest_ms))
        };
        Minute {
            at: Timestamp::from_second(self.minute * 60).unwrap_or(Timestamp::UNIX_EPOCH),
            requests: self.requests,
            errors: self.errors,
            frames,
            p50_ms: quantile(0.5),
            p95_ms: quantile(0.95),
            max_ms: (frames > 0).then_some(self.longest_ms),
            jobs_ended: self.jobs_ended,
            jobs_failed: self.jobs_failed,
        }
    }
}

impl HourlyStats {
    /// Counts an answer; of a frame that was localized, with the time it took.
    pub fn answered(&self, now: Timestamp, status: u16, frame: Option<Duration>) {
        self.count(now, |counts| {
            counts.requests += 1;
            counts.errors += u64::from(status == 429 || status >= 500);
            if let Some(took) = frame {
                let ms = took.as_secs_f64() * 1e3;
                let step = ((ms / SHORTEST_MS).log2() * STEPS_AN_OCTAVE).max(0.0) as usize;
                counts.times[step.min(STEPS - 1)] += 1;
                counts.longest_ms = counts.longest_ms.max(ms);
            }
        });
    }

    /// Counts a job that ended.
    pub fn job_ended(&self, now: Timestamp, failed: bool) {
        self.count(now, |counts| {
            counts.jobs_ended += 1;
            counts.jobs_failed += u64::from(failed);
        });
    }

    /// The minutes in which something was done, the oldest first.
    pub fn minutes(&self, now: Timestamp) -> Vec<Minute> {
        let from = now.as_second().div_euclid(60) - MINUTES as i64;
        self.lock().iter().filter(|counts| counts.minute > from).map(Counts::told).collect()
    }

    fn count(&self, now: Timestamp, change: impl FnOnce(&mut Counts)) {
        let minute = now.as_second().div_euclid(60);
        let mut minutes = self.lock();
        // A clock that was set back counts in the last minute there is.
        if minutes.back().is_none_or(|last| last.minute < minute) {
            minutes.push_back(Counts::new(minute));
        }
        if minutes.len() > MINUTES {
            minutes.pop_front();
        }
        if let Some(counts) = minutes.back_mut() {
            change(counts);
        }
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Counts>> {
        self.0.lock()
    }
}

/// The last warnings and errors of the log, the newest first; the same one again is counted.
#[derive(Debug, Default)]
pub struct LogIssues(Mutex<VecDeque<LogIssue>>);

impl LogIssues {
    /// What there is.
    pub fn last(&self) -> Vec<LogIssue> {
        self.lock().iter().cloned().collect()
    }

    fn add(&self, place: &str, detail: String) {
        let mut troubles = self.lock();
        let known = troubles.iter().position(|of| of.place == place && of.detail == detail);
        let count = known.and_then(|at| troubles.remove(at)).map_or(0, |before| before.count);
        let at = Timestamp::now();
        troubles.push_front(LogIssue { at, place: place.to_owned(), detail, count: count + 1 });
        troubles.truncate(TROUBLES);
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<LogIssue>> {
        self.0.lock()
    }
}

/// Listens to the log for [`LogIssues`].
pub(super) struct Listener(pub std::sync::Arc<LogIssues>);

impl<S: Subscriber> Layer<S> for Listener {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut words = MessageVisitor::default();
        event.record(&mut words);
        let mut detail = words.message;
        detail.push_str(&words.fields);
        if let Some(end) = (0..=LONGEST).rev().find(|&at| detail.is_char_boundary(at)) {
            detail.truncate(end);
        }
        let place = event.metadata().target();
        self.0.add(place.strip_prefix("whereabouts::").unwrap_or(place), detail);
    }
}

/// An event in words.
#[derive(Default)]
struct MessageVisitor {
    message: String,
    fields: String,
}

impl Visit for MessageVisitor {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing to a string does not fail. What tells one request from another would make each trouble
        // another one.
        let _ = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            "request_id" => Ok(()),
            name => write!(self.fields, " {name}={value:?}"),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(second: i64) -> Timestamp {
        Timestamp::from_second(second).unwrap()
    }

    #[test]
    fn a_minute_knows_its_quantiles_and_an_hour_forgets() {
        let hour = HourlyStats::default();
        for ms in 1..=100 {
            hour.answered(at(120 + ms % 60), 200, Some(Duration::from_millis(ms as u64)));
        }
        hour.answered(at(170), 503, None);
        hour.answered(at(170), 404, None);
        hour.job_ended(at(179), true);
        let [minute] = &hour.minutes(at(180))[..] else { panic!() };
        assert_eq!(
            (minute.at, minute.requests, minute.errors, minute.frames),
            (at(120), 102, 1, 100)
        );
        assert_eq!((minute.jobs_ended, minute.jobs_failed, minute.max_ms), (1, 1, Some(100.0)));
        let near = |got: Option<f64>, expected: f64| (got.unwrap() / expected - 1.0).abs() < 0.06;
        assert!(near(minute.p50_ms, 50.0) && near(minute.p95_ms, 95.0), "{minute:?}");

        hour.answered(at(60 * 61), 200, None);
        let minutes = hour.minutes(at(60 * 61));
        assert_eq!((minutes.len(), minutes[1].p50_ms), (2, None));
        assert_eq!(hour.minutes(at(60 * 62)).len(), 1);
        for minute in 0..200 {
            hour.answered(at(60 * (100 + minute)), 200, Some(Duration::from_secs(1000)));
        }
        assert_eq!(hour.minutes(at(60 * 299)).len(), MINUTES);
    }

    #[test]
    fn the_same_trouble_again_is_counted() {
        let troubles = LogIssues::default();
        for index in 0..60 {
            troubles.add("a", format!("{index}"));
        }
        troubles.add("a", "30".into());
        let last = troubles.last();
        assert_eq!((last.len(), &*last[0].detail, last[0].count), (TROUBLES, "30", 2));
    }
}
