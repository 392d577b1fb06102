//! What happens, counted as it happens.

use std::fmt;
use std::time::Duration;

use jiff::Timestamp;
use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Metric, Registry};

use super::levels::{Gauges, Levels};
use super::recent::LastHour;
use super::refused::RefusedFor;
use crate::domain::{Job, JobState};
use crate::retrieve::Extraction;
use crate::store::RemovedJobs;

/// The routes that localize a frame.
const FRAME_ROUTES: [&str; 2] = ["/localize", "/whereabouts.v1.LocalizationService/Localize"];

/// What is counted, in the words of the API.
#[derive(Debug)]
pub struct Metrics {
    /// The last hour.
    pub last_hour: LastHour,
    registry: Registry,
    levels: Gauges,
    requests: Family<RequestLabels, Counter>,
    request_seconds: Family<RouteLabels, Histogram, fn() -> Histogram>,
    stage_seconds: Family<StageLabels, Histogram, fn() -> Histogram>,
    batch_pictures: Histogram,
    neighbours_checked: Family<CheckLabels, Counter>,
    jobs: Family<JobLabels, Counter>,
    job_seconds: Family<RefinerLabels, Histogram, fn() -> Histogram>,
    submitted_jobs: Counter,
    removed_jobs: Family<RemovedLabels, Counter>,
    removed_frame_bytes: Counter,
    model_calls: Family<RefinerLabels, Counter>,
    cached_descriptions: Family<RefinerLabels, Counter>,
    tokens: Family<TokenLabels, Counter>,
    description_lookups: Family<LookupLabels, Counter>,
    refused: Family<RefusedLabels, Counter>,
    connections: Gauge,
    webhook_attempts: Family<OutcomeLabels, Counter>,
}

/// What came of looking for a pair's description.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CacheLookup {
    /// It was there.
    Hit,
    /// That of a similar frame was there.
    Similar,
    /// It had to be bought.
    Miss,
}

/// What came of an attempt to deliver a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptOutcome {
    /// It was taken.
    Delivered,
    /// It is tried again.
    Failed,
    /// It is given up.
    Dead,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RequestLabels {
    method: String,
    route: String,
    status: u16,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RouteLabels {
    route: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct StageLabels {
    stage: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct JobLabels {
    refiner: &'static str,
    state: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RemovedLabels {
    why: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RefinerLabels {
    refiner: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct TokenLabels {
    refiner: &'static str,
    direction: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct LookupLabels {
    result: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct CheckLabels {
    map: String,
    found: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RefusedLabels {
    reason: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OutcomeLabels {
    outcome: &'static str,
}

/// Registers a metric under its name, with what it means.
pub(super) fn add<M: Metric + Clone>(
    registry: &mut Registry,
    name: &str,
    help: &str,
    metric: M,
) -> M {
    registry.register(name, help, metric.clone());
    metric
}

/// From half a millisecond to about 16 seconds.
fn latency() -> Histogram {
    Histogram::new(exponential_buckets(0.0005, 2.0, 16))
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

impl Metrics {
    /// All zero.
    pub fn new() -> Self {
        let mut all = Registry::with_prefix("whereabouts");
        let registry = &mut all;
        Self {
            last_hour: LastHour::default(),
            requests: add(registry, "http_requests", "Requests answered", Family::default()),
            request_seconds: add(
                registry,
                "http_request_seconds",
                "Time from the request's head to the answer's",
                Family::new_with_constructor(latency),
            ),
            stage_seconds: add(
                registry,
                "stage_seconds",
                "Time in one stage of localizing or indexing a picture",
                Family::new_with_constructor(latency),
            ),
            batch_pictures: add(
                registry,
                "batch_pictures",
                "Pictures that the model was run on together, counted for each picture",
                Histogram::new(exponential_buckets(1.0, 2.0, 7)),
            ),
            neighbours_checked: add(
                registry,
                "neighbours_checked",
                "Nearest images, by exact search, of frames whose search was checked: whether the index had \
                 found them (index.check_s)",
                Family::default(),
            ),
            jobs: add(registry, "jobs_ended", "Jobs that ended", Family::default()),
            job_seconds: add(
                registry,
                "job_seconds",
                "Time from a job's submission to its end",
                Family::new_with_constructor(latency),
            ),
            submitted_jobs: add(registry, "jobs_submitted", "Jobs queued", Counter::default()),
            removed_jobs: add(
                registry,
                "jobs_removed",
                "Ended jobs that were removed, because of their age or of their number (count)",
                Family::default(),
            ),
            removed_frame_bytes: add(
                registry,
                "frame_bytes_removed",
                "Bytes of frames removed with their jobs",
                Counter::default(),
            ),
            model_calls: add(
                registry,
                "model_calls",
                "Calls to a model outside, by jobs that ended",
                Family::default(),
            ),
            cached_descriptions: add(
                registry,
                "cached_descriptions",
                "Descriptions that were known from an earlier job",
                Family::default(),
            ),
            tokens: add(
                registry,
                "tokens",
                "Tokens sent to a model outside (prompt) and received (completion)",
                Family::default(),
            ),
            description_lookups: add(
                registry,
                "description_lookups",
                "Pairs whose description was looked for: known (hit), known of a nearly equal frame \
                 (similar), or bought (miss)",
                Family::default(),
            ),
            refused: add(
                registry,
                "refused",
                "Requests, jobs and connections that were refused or broken off, by reason",
                Family::default(),
            ),
            connections: add(
                registry,
                "connections",
                "Connections that are open",
                Gauge::default(),
            ),
            webhook_attempts: add(
                registry,
                "webhook_attempts",
                "Attempts to deliver a message to a webhook: delivered, failed (it is tried again) or dead \
                 (it is given up)",
                Family::default(),
            ),
            levels: Gauges::new(registry),
            registry: all,
        }
    }

    /// Counts an answered request.
    pub fn request(&self, method: &str, route: &str, status: u16, took: Duration) {
        let is_frame = status == 200 && FRAME_ROUTES.contains(&route);
        self.last_hour.answered(Timestamp::now(), status, is_frame.then_some(took));
        let route = route.to_owned();
        self.request_seconds
            .get_or_create(&RouteLabels { route: route.clone() })
            .observe(took.as_secs_f64());
        self.requests.get_or_create(&RequestLabels { method: method.into(), route, status }).inc();
    }

    /// Counts a frame of a stream of gRPC that was localized.
    pub fn frame_of_stream(&self, took: Duration) {
        self.last_hour.answered(Timestamp::now(), 200, Some(took));
    }

    /// Counts what was refused.
    pub fn refused(&self, reason: RefusedFor) {
        self.refused.get_or_create(&RefusedLabels { reason: reason.as_str() }).inc();
    }

    /// Counts a connection that was opened.
    pub fn connection_opened(&self) {
        self.connections.inc();
    }

    /// Counts a connection that was closed.
    pub fn connection_closed(&self) {
        self.connections.dec();
    }

    /// Counts one extraction.
    pub fn observe_extraction(&self, extraction: &Extraction) {
        self.batch_pictures.observe(extraction.batch as f64);
        let times = extraction.times;
        for (stage, time) in [("decode", times.decode), ("extract", times.extract)] {
            self.stage_seconds.get_or_create(&StageLabels { stage }).observe(time.as_secs_f64());
        }
    }

    /// Counts a search.
    pub fn observe_search(&self, took: Duration) {
        let stage = StageLabels { stage: "search" };
        self.stage_seconds.get_or_create(&stage).observe(took.as_secs_f64());
    }

    /// Counts the nearest images of a frame whose search was checked, and those of them that it had found.
    pub fn search_checked(&self, map: &str, nearest: usize, found: usize) {
        for (word, count) in [("yes", found), ("no", nearest.saturating_sub(found))] {
            let labels = CheckLabels { map: map.to_owned(), found: word };
            self.neighbours_checked.get_or_create(&labels).inc_by(count as u64);
        }
    }

    /// Counts a queued job.
    pub fn job_submitted(&self) {
        self.submitted_jobs.inc();
    }

    /// Counts jobs that had their time.
    pub fn jobs_removed(&self, removed: &RemovedJobs) {
        for (why, jobs) in [("age", removed.by_age), ("count", removed.by_count)] {
            self.removed_jobs.get_or_create(&RemovedLabels { why }).inc_by(jobs as u64);
        }
        self.removed_frame_bytes.inc_by(removed.bytes);
    }

    /// Counts an ended job.
    pub fn job_ended(&self, job: &Job) {
        self.last_hour.job_ended(Timestamp::now(), job.state == JobState::Failed);
        let refiner = job.refiner.as_str();
        self.jobs.get_or_create(&JobLabels { refiner, state: job.state.as_str() }).inc();
        let (of, usage) = (RefinerLabels { refiner }, job.usage);
        self.model_calls.get_or_create(&of).inc_by(usage.calls.into());
        self.cached_descriptions.get_or_create(&of).inc_by(usage.cached.into());
        for (direction, tokens) in
            [("prompt", usage.prompt_tokens), ("completion", usage.completion_tokens)]
        {
            self.tokens.get_or_create(&TokenLabels { refiner, direction }).inc_by(tokens);
        }
        if let Some(finished) = job.finished_at {
            let took = finished.duration_since(job.created_at).as_secs_f64();
            self.job_seconds.get_or_create(&RefinerLabels { refiner }).observe(took.max(0.0));
        }
    }

    /// Counts a search for a pair's description.
    pub fn description_lookup(&self, found: CacheLookup) {
        let result = match found {
            CacheLookup::Hit => "hit",
            CacheLookup::Similar => "similar",
            CacheLookup::Miss => "miss",
        };
        self.description_lookups.get_or_create(&LookupLabels { result }).inc();
    }

    /// Counts an attempt to deliver a message to a webhook.
    pub fn webhook_attempt(&self, outcome: AttemptOutcome) {
        let outcome = match outcome {
            AttemptOutcome::Delivered => "delivered",
            AttemptOutcome::Failed => "failed",
            AttemptOutcome::Dead => "dead",
        };
        self.webhook_attempts.get_or_create(&OutcomeLabels { outcome }).inc();
    }

    /// Sets what is measured when it is asked for.
    pub fn set_levels(&self, levels: &Levels) {
        self.levels.set(levels);
    }

    /// All metrics in the OpenMetrics text format.
    pub fn encode(&self) -> Result<String, fmt::Error> {
        let mut out = String::new();
        text::encode(&mut out, &self.registry)?;
        Ok(out)
    }
}
