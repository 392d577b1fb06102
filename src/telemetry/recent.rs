//! Statistics of the last hour per minute, and recent warnings and errors, for the operator console.
//!
//! The histograms are ours: hdrhistogram needs twice the memory for the same accuracy.

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

/// Number of minutes kept.
const MINUTES: usize = 60;

/// Number of distinct log issues kept.
const MAX_ISSUES: usize = 50;

/// Maximum length of the text of an issue in bytes.
const MAX_DETAIL_BYTES: usize = 500;

/// Response times are counted in buckets that grow by 2^(1/8), from half a millisecond to about a minute.
const BUCKETS_PER_OCTAVE: f64 = 8.0;
const BUCKETS: usize = 136;
const FIRST_BUCKET_MS: f64 = 0.5;

/// Activity in one minute.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct Minute {
    /// Start of the minute.
    pub at: Timestamp,
    /// Requests answered.
    pub requests: u64,
    /// Requests answered with 429 or 5xx.
    pub errors: u64,
    /// Frames localized.
    pub frames: u64,
    /// Median response time for frames in milliseconds, accurate to 5 %.
    pub p50_ms: Option<f64>,
    /// 95th percentile of the response time for frames in milliseconds.
    pub p95_ms: Option<f64>,
    /// Maximum response time for frames in milliseconds.
    pub max_ms: Option<f64>,
    /// Jobs that finished.
    pub jobs_ended: u64,
    /// Jobs that failed.
    pub jobs_failed: u64,
}

/// A warning or error in the log.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
#[schema(as = Trouble)]
pub struct LogIssue {
    /// Time of the last occurrence.
    pub at: Timestamp,
    /// Part of the server that logged the issue.
    #[serde(rename = "where")]
    pub place: String,
    /// Log message with its fields.
    pub detail: String,
    /// Number of occurrences.
    pub count: u64,
}

/// Statistics of the last hour. Minutes without activity have no entry.
#[derive(Debug, Default)]
pub struct HourlyStats(Mutex<VecDeque<Counts>>);

#[derive(Debug)]
struct Counts {
    /// Minutes since the Unix epoch.
    minute: i64,
    requests: u64,
    errors: u64,
    jobs_ended: u64,
    jobs_failed: u64,
    /// Histogram of the response times for frames.
    times: [u32; BUCKETS],
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
            times: [0; BUCKETS],
            longest_ms: 0.0,
        }
    }

    fn to_minute(&self) -> Minute {
        let frames: u64 = self.times.iter().map(|&count| u64::from(count)).sum();
        let quantile = |share: f64| {
            let rank = (share * frames as f64).ceil().max(1.0) as u64;
            let mut below = 0;
            let bucket = self.times.iter().position(|&count| {
                below += u64::from(count);
                below >= rank
            })?;
            // The middle of the bucket on the logarithmic scale.
            let middle = FIRST_BUCKET_MS * ((bucket as f64 + 0.5) / BUCKETS_PER_OCTAVE).exp2();
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
    /// Counts a response. For a localized frame, `frame` is the response time.
    pub fn answered(&self, now: Timestamp, status: u16, frame: Option<Duration>) {
        self.count(now, |counts| {
            counts.requests += 1;
            counts.errors += u64::from(status == 429 || status >= 500);
            if let Some(took) = frame {
                let ms = took.as_secs_f64() * 1e3;
                let bucket = ((ms / FIRST_BUCKET_MS).log2() * BUCKETS_PER_OCTAVE).max(0.0) as usize;
                counts.times[bucket.min(BUCKETS - 1)] += 1;
                counts.longest_ms = counts.longest_ms.max(ms);
            }
        });
    }

    /// Counts a finished job.
    pub fn job_ended(&self, now: Timestamp, failed: bool) {
        self.count(now, |counts| {
            counts.jobs_ended += 1;
            counts.jobs_failed += u64::from(failed);
        });
    }

    /// The minutes of the last hour with activity, oldest first.
    pub fn minutes(&self, now: Timestamp) -> Vec<Minute> {
        let from = now.as_second().div_euclid(60) - MINUTES as i64;
        self.lock().iter().filter(|counts| counts.minute > from).map(Counts::to_minute).collect()
    }

    fn count(&self, now: Timestamp, change: impl FnOnce(&mut Counts)) {
        let minute = now.as_second().div_euclid(60);
        let mut minutes = self.lock();
        // If the clock was set back, count in the newest minute.
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

/// Recent warnings and errors of the log, newest first. Repetitions are counted.
#[derive(Debug, Default)]
pub struct LogIssues(Mutex<VecDeque<LogIssue>>);

impl LogIssues {
    /// All issues, newest first.
    pub fn last(&self) -> Vec<LogIssue> {
        self.lock().iter().cloned().collect()
    }

    fn add(&self, place: &str, detail: String) {
        let mut issues = self.lock();
        let known = issues.iter().position(|issue| issue.place == place && issue.detail == detail);
        let count = known.and_then(|index| issues.remove(index)).map_or(0, |issue| issue.count);
        let at = Timestamp::now();
        issues.push_front(LogIssue { at, place: place.to_owned(), detail, count: count + 1 });
        issues.truncate(MAX_ISSUES);
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<LogIssue>> {
        self.0.lock()
    }
}

/// Collects warnings and errors of the log into [`LogIssues`].
pub(super) struct IssueCollector(pub std::sync::Arc<LogIssues>);

impl<S: Subscriber> Layer<S> for IssueCollector {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut visitor = MessageVisitor::default();
        event.record(&mut visitor);
        let mut detail = visitor.message;
        detail.push_str(&visitor.fields);
        if let Some(end) = (0..=MAX_DETAIL_BYTES).rev().find(|&at| detail.is_char_boundary(at)) {
            detail.truncate(end);
        }
        let place = event.metadata().target();
        self.0.add(place.strip_prefix("whereabouts::").unwrap_or(place), detail);
    }
}

/// Formats the message and the fields of an event.
#[derive(Default)]
struct MessageVisitor {
    message: String,
    fields: String,
}

impl Visit for MessageVisitor {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing to a string cannot fail. The request id is left out, because it would make every occurrence
        // a distinct issue.
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
    fn minutes_have_quantiles_and_expire_after_an_hour() {
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
    fn a_repeated_issue_is_counted() {
        let issues = LogIssues::default();
        for index in 0..60 {
            issues.add("a", format!("{index}"));
        }
        issues.add("a", "30".into());
        let last = issues.last();
        assert_eq!((last.len(), &*last[0].detail, last[0].count), (MAX_ISSUES, "30", 2));
    }
}
