//! Logs and metrics.

use std::io::IsTerminal;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::Registry;
use tracing_subscriber::EnvFilter;

use crate::config::{Log, LogFormat};
use crate::domain::Job;
use crate::retrieve::StageTimes;

/// Starts logging to standard error. A second call changes nothing.
pub fn init_logs(log: &Log) -> Result<(), String> {
    let filter = EnvFilter::try_new(&log.filter)
        .map_err(|error| format!("log.filter cannot be read: {error}"))?;
    let pretty = match log.format {
        LogFormat::Pretty => true,
        LogFormat::Json => false,
        LogFormat::Auto => std::io::stderr().is_terminal(),
    };
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    let _ = match pretty {
        true => builder.with_target(false).try_init(),
        false => builder.json().flatten_event(true).try_init(),
    };
    Ok(())
}

/// What is counted, in the words of the API.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    requests: Family<RequestLabels, Counter>,
    request_seconds: Family<RouteLabels, Histogram, fn() -> Histogram>,
    stage_seconds: Family<StageLabels, Histogram, fn() -> Histogram>,
    jobs: Family<JobLabels, Counter>,
    job_seconds: Family<RefinerLabels, Histogram, fn() -> Histogram>,
    queued_jobs: Gauge,
    submitted_jobs: Counter,
    model_calls: Family<RefinerLabels, Counter>,
    cached_descriptions: Family<RefinerLabels, Counter>,
    tokens: Family<TokenLabels, Counter>,
    map_images: Family<MapLabels, Gauge>,
    dense_cache_bytes: Gauge<f64, AtomicU64>,
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
struct RefinerLabels {
    refiner: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct TokenLabels {
    refiner: &'static str,
    direction: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct MapLabels {
    map: String,
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
            registry: Registry::with_prefix("whereabouts"),
            requests: Family::default(),
            request_seconds: Family::new_with_constructor(latency),
            stage_seconds: Family::new_with_constructor(latency),
            jobs: Family::default(),
            job_seconds: Family::new_with_constructor(latency),
            queued_jobs: Gauge::default(),
            submitted_jobs: Counter::default(),
            model_calls: Family::default(),
            cached_descriptions: Family::default(),
            tokens: Family::default(),
            map_images: Family::default(),
            dense_cache_bytes: Gauge::default(),
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
        registry.register("jobs_ended", "Jobs that ended", self.jobs.clone());
        registry.register("jobs_submitted", "Jobs queued", self.submitted_jobs.clone());
        registry.register(
            "job_seconds",
            "Time from a job's submission to its end",
            self.job_seconds.clone(),
        );
        registry.register("jobs_queued", "Jobs that wait or run", self.queued_jobs.clone());
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
        registry.register("map_images", "Images in a map", self.map_images.clone());
        registry.register(
            "dense_cache_bytes",
            "Memory held by cached dense features",
            self.dense_cache_bytes.clone(),
        );
    }

    /// Counts an answered request.
    pub fn request(&self, method: &str, route: &str, status: u16, took: Duration) {
        let route = route.to_owned();
        self.request_seconds
            .get_or_create(&RouteLabels { route: route.clone() })
            .observe(took.as_secs_f64());
        self.requests.get_or_create(&RequestLabels { method: method.into(), route, status }).inc();
    }

    /// Counts the stages of one extraction.
    pub fn observe_stages(&self, times: StageTimes) {
        for (stage, time) in [("decode", times.decode), ("extract", times.extract)] {
            self.stage_seconds.get_or_create(&StageLabels { stage }).observe(time.as_secs_f64());
        }
    }

    /// Counts a search.
    pub fn observe_search(&self, took: Duration) {
        let stage = StageLabels { stage: "search" };
        self.stage_seconds.get_or_create(&stage).observe(took.as_secs_f64());
    }

    /// Counts a queued job.
    pub fn job_submitted(&self) {
        self.submitted_jobs.inc();
    }

    /// Counts an ended job.
    pub fn job_ended(&self, job: &Job) {
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

    /// Sets what is measured when it is asked for: images of each map, jobs that wait, bytes cached.
    pub fn set_levels(&self, maps: &[(String, usize)], queued: usize, dense_cache_bytes: usize) {
        self.map_images.clear();
        for (map, images) in maps {
            let labels = MapLabels { map: map.clone() };
            self.map_images.get_or_create(&labels).set(*images as i64);
        }
        self.queued_jobs.set(queued as i64);
        self.dense_cache_bytes.set(dense_cache_bytes as f64);
    }

    /// All metrics in the OpenMetrics text format.
    pub fn encode(&self) -> Result<String, std::fmt::Error> {
        let mut out = String::new();
        text::encode(&mut out, &self.registry)?;
        Ok(out)
    }
}
