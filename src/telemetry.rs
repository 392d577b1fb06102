//! Logs, metrics and traces.

mod recent;
mod refused;
pub mod traces;
mod webhooks;

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use jiff::Timestamp;
use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::Registry;
use tracing_subscriber::filter::{FilterExt, LevelFilter, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, fmt};

use self::recent::Listener;
pub use self::recent::{LastHour, Minute, Trouble, Troubles};
pub use self::refused::RefusedFor;
pub use self::traces::{TraceSettings, Traces};
pub use self::webhooks::AttemptOutcome;
use self::webhooks::OutcomeLabels;
use crate::config::{Log, LogFormat};
use crate::domain::{Job, JobState};
use crate::refine::mllm::MllmLevels;
use crate::retrieve::{AdmissionLevels, Extraction};
use crate::store::RemovedJobs;

/// Starts logging to standard error and tracing, and gives the last warnings and errors, and what sends the
/// traces. A second call changes nothing.
pub fn init(log: &Log, traces: &TraceSettings) -> Result<(Arc<Troubles>, Traces), String> {
    let filter = EnvFilter::try_new(&log.filter)
        .map_err(|error| format!("log.filter cannot be read: {error}"))?;
    let pretty = match log.format {
        LogFormat::Pretty => true,
        LogFormat::Json => false,
        LogFormat::Auto => std::io::stderr().is_terminal(),
    };
    let lines = fmt::layer().with_writer(std::io::stderr);
    let lines = match pretty {
        true => lines.with_target(false).boxed(),
        false => lines.json().flatten_event(true).boxed(),
    };
    let troubles = Arc::new(Troubles::default());
    let listener = Listener(Arc::clone(&troubles)).with_filter(LevelFilter::WARN);
    let traces = Traces::start(traces)?;
    let no_span_of_a_trace = filter_fn(|about| !(about.is_span() && traces::is_ours(about)));
    let _ = tracing_subscriber::registry()
        .with(traces.layer())
        .with(lines.with_filter(filter.and(no_span_of_a_trace)))
        .with(listener)
        .try_init();
    Ok((troubles, traces))
}

/// The routes that localize a frame.
const FRAME_ROUTES: [&str; 2] = ["/localize", "/whereabouts.v1.LocalizationService/Localize"];

/// What is counted, in the words of the API.
#[derive(Debug)]
pub struct Metrics {
    /// The last hour.
    pub last_hour: LastHour,
    registry: Registry,
    requests: Family<RequestLabels, Counter>,
    request_seconds: Family<RouteLabels, Histogram, fn() -> Histogram>,
    stage_seconds: Family<StageLabels, Histogram, fn() -> Histogram>,
    batch_pictures: Histogram,
    neighbours_checked: Family<CheckLabels, Counter>,
    jobs: Family<JobLabels, Counter>,
    job_seconds: Family<RefinerLabels, Histogram, fn() -> Histogram>,
    queued_jobs: Gauge,
    oldest_job_seconds: Gauge<f64, AtomicU64>,
    submitted_jobs: Counter,
    removed_jobs: Family<RemovedLabels, Counter>,
    removed_frame_bytes: Counter,
    db_bytes: Gauge,
    model_calls: Family<RefinerLabels, Counter>,
    cached_descriptions: Family<RefinerLabels, Counter>,
    tokens: Family<TokenLabels, Counter>,
    description_lookups: Family<LookupLabels, Counter>,
    description_cache_entries: Gauge,
    description_cache_bytes: Gauge,
    mllm_suspended: Gauge,
    mllm_tokens_today: Gauge,
    mllm_money_today: Gauge<f64, AtomicU64>,
    map_images: Family<MapLabels, Gauge>,
    index_bytes: Family<MapLabels, Gauge>,
    dense_cache_bytes: Gauge<f64, AtomicU64>,
    refused: Family<RefusedLabels, Counter>,
    permits: Gauge,
    permits_in_use: Gauge,
    waiting: Family<ClassLabels, Gauge>,
    connections: Gauge,
    webhook_attempts: Family<OutcomeLabels, Counter>,
    waiting_deliveries: Gauge,
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

/// What is measured when it is asked for.
#[derive(Debug, Clone)]
pub struct Levels {
    /// Images of each map.
    pub maps: Vec<(String, usize)>,
    /// Bytes of each map's descriptors and their index.
    pub index_bytes: Vec<(String, u64)>,
    /// Jobs that wait or run.
    pub queued: usize,
    /// How long ago the oldest of them was submitted; zero, if there is none.
    pub oldest_job: Duration,
    /// Deliveries to webhooks that wait.
    pub waiting_deliveries: usize,
    /// Bytes of the database's files.
    pub db_bytes: u64,
    /// Bytes of cached dense features.
    pub dense_cache_bytes: usize,
    /// Pictures in work and waiting.
    pub admission: AdmissionLevels,
    /// How the refiner stands, if it asks models outside.
    pub mllm: Option<MllmLevels>,
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
struct MapLabels {
    map: String,
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
struct ClassLabels {
    class: &'static str,
}

/// Sets a level of each map; one that is gone has none any more.
fn set_of_maps<'a>(
    family: &Family<MapLabels, Gauge>,
    levels: impl Iterator<Item = (&'a String, i64)>,
) {
    family.clear();
    for (map, level) in levels {
        family.get_or_create(&MapLabels { map: map.clone() }).set(level);
    }
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
        let mut metrics = Self {
            last_hour: LastHour::default(),
            registry: Registry::with_prefix("whereabouts"),
            requests: Family::default(),
            request_seconds: Family::new_with_constructor(latency),
            stage_seconds: Family::new_with_constructor(latency),
            batch_pictures: Histogram::new(exponential_buckets(1.0, 2.0, 7)),
            neighbours_checked: Family::default(),
            jobs: Family::default(),
            job_seconds: Family::new_with_constructor(latency),
            queued_jobs: Gauge::default(),
            oldest_job_seconds: Gauge::default(),
            submitted_jobs: Counter::default(),
            removed_jobs: Family::default(),
            removed_frame_bytes: Counter::default(),
            db_bytes: Gauge::default(),
            model_calls: Family::default(),
            cached_descriptions: Family::default(),
            tokens: Family::default(),
            description_lookups: Family::default(),
            description_cache_entries: Gauge::default(),
            description_cache_bytes: Gauge::default(),
            mllm_suspended: Gauge::default(),
            mllm_tokens_today: Gauge::default(),
            mllm_money_today: Gauge::default(),
            map_images: Family::default(),
            index_bytes: Family::default(),
            dense_cache_bytes: Gauge::default(),
            refused: Family::default(),
            permits: Gauge::default(),
            permits_in_use: Gauge::default(),
            waiting: Family::default(),
            connections: Gauge::default(),
            webhook_attempts: Family::default(),
            waiting_deliveries: Gauge::default(),
        };
        metrics.register();
        metrics
    }

    fn register(&mut self) {
        let registry = &mut self.registry;
        registry.register("http_requests", "Requests answered", self.requests.clone());
        registry.register(
            "http_request_seconds",
            "Time from the request's head to the answer's",
            self.request_seconds.clone(),
        );
        registry.register(
            "stage_seconds",
            "Time in one stage of localizing or indexing a picture",
            self.stage_seconds.clone(),
        );
        registry.register(
            "batch_pictures",
            "Pictures that the model was run on together, counted for each picture",
            self.batch_pictures.clone(),
        );
        registry.register(
            "neighbours_checked",
            "Nearest images, by exact search, of frames whose search was checked: whether the index had \
             found them (index.check_s)",
            self.neighbours_checked.clone(),
        );
        registry.register("jobs_ended", "Jobs that ended", self.jobs.clone());
        registry.register("jobs_submitted", "Jobs queued", self.submitted_jobs.clone());
        registry.register(
            "job_seconds",
            "Time from a job's submission to its end",
            self.job_seconds.clone(),
        );
        registry.register("jobs_queued", "Jobs that wait or run", self.queued_jobs.clone());
        registry.register(
            "oldest_job_seconds",
            "Time since the oldest job that waits or runs was submitted; 0 if there is none",
            self.oldest_job_seconds.clone(),
        );
        registry.register(
            "jobs_removed",
            "Ended jobs that were removed, because of their age or of their number (count)",
            self.removed_jobs.clone(),
        );
        registry.register(
            "frame_bytes_removed",
            "Bytes of frames removed with their jobs",
            self.removed_frame_bytes.clone(),
        );
        registry.register("db_bytes", "Bytes of the database's files", self.db_bytes.clone());
        registry.register(
            "model_calls",
            "Calls to a model outside, by jobs that ended",
            self.model_calls.clone(),
        );
        registry.register(
            "cached_descriptions",
            "Descriptions that were known from an earlier job",
            self.cached_descriptions.clone(),
        );
        registry.register(
            "tokens",
            "Tokens sent to a model outside (prompt) and received (completion)",
            self.tokens.clone(),
        );
        registry.register(
            "description_lookups",
            "Pairs whose description was looked for: known (hit), known of a nearly equal frame \
             (similar), or bought (miss)",
            self.description_lookups.clone(),
        );
        registry.register(
            "description_cache_entries",
            "Descriptions that are kept",
            self.description_cache_entries.clone(),
        );
        registry.register(
            "description_cache_bytes",
            "Bytes of the descriptions that are kept",
            self.description_cache_bytes.clone(),
        );
        registry.register(
            "mllm_suspended",
            "Whether calls to the MLLM are suspended because the last ones failed",
            self.mllm_suspended.clone(),
        );
        registry.register(
            "mllm_tokens_today",
            "Tokens spent since midnight UTC, calls in progress included",
            self.mllm_tokens_today.clone(),
        );
        registry.register(
            "mllm_money_today",
            "Money spent since midnight UTC, calls in progress included",
            self.mllm_money_today.clone(),
        );
        registry.register("map_images", "Images in a map", self.map_images.clone());
        registry.register(
            "index_bytes",
            "Bytes of a map's descriptors and of their index",
            self.index_bytes.clone(),
        );
        registry.register(
            "dense_cache_bytes",
            "Memory held by cached dense features",
            self.dense_cache_bytes.clone(),
        );
        registry.register(
            "refused",
            "Requests, jobs and connections that were refused or broken off, by reason",
            self.refused.clone(),
        );
        registry.register(
            "permits",
            "Pictures that may be decoded and inferred at a time",
            self.permits.clone(),
        );
        registry.register(
            "permits_in_use",
            "Pictures that are decoded and inferred",
            self.permits_in_use.clone(),
        );
        registry.register(
            "pictures_waiting",
            "Pictures that wait for a permit, by what it is for",
            self.waiting.clone(),
        );
        registry.register("connections", "Connections that are open", self.connections.clone());
        registry.register(
            "webhook_attempts",
            "Attempts to deliver a message to a webhook: delivered, failed (it is tried again) or dead \
             (it is given up)",
            self.webhook_attempts.clone(),
        );
        registry.register(
            "webhook_deliveries_waiting",
            "Deliveries to webhooks that wait",
            self.waiting_deliveries.clone(),
        );
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

    /// Sets what is measured when it is asked for.
    pub fn set_levels(&self, levels: &Levels) {
        set_of_maps(
            &self.map_images,
            levels.maps.iter().map(|(map, images)| (map, *images as i64)),
        );
        let sizes = levels.index_bytes.iter();
        set_of_maps(&self.index_bytes, sizes.map(|(map, bytes)| (map, *bytes as i64)));
        self.queued_jobs.set(levels.queued as i64);
        self.oldest_job_seconds.set(levels.oldest_job.as_secs_f64());
        self.waiting_deliveries.set(levels.waiting_deliveries as i64);
        self.db_bytes.set(levels.db_bytes as i64);
        self.dense_cache_bytes.set(levels.dense_cache_bytes as f64);
        let AdmissionLevels { permits, in_use, localize, index, background } = levels.admission;
        self.permits.set(permits as i64);
        self.permits_in_use.set(in_use as i64);
        for (class, waiting) in
            [("localize", localize), ("index", index), ("background", background)]
        {
            self.waiting.get_or_create(&ClassLabels { class }).set(waiting as i64);
        }
        if let Some(mllm) = levels.mllm {
            self.mllm_suspended.set(mllm.suspended.into());
            self.mllm_tokens_today.set(mllm.spent_today.tokens as i64);
            self.mllm_money_today.set(mllm.spent_today.money);
            self.description_cache_entries.set(mllm.cache.entries as i64);
            self.description_cache_bytes.set(mllm.cache.bytes as i64);
        }
    }

    /// All metrics in the OpenMetrics text format.
    pub fn encode(&self) -> Result<String, std::fmt::Error> {
        let mut out = String::new();
        text::encode(&mut out, &self.registry)?;
        Ok(out)
    }
}
