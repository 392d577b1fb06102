//! Metric families of refinement: ended jobs, their cost, and lookups in the description cache.

use std::sync::Arc;

use jiff::Timestamp;
use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use whereabouts_core::{Job, JobState};
use whereabouts_telemetry::HourlyStats;
use whereabouts_telemetry::metrics::{Registry, latency, register};

/// Metric families of refinement jobs and of the description cache.
#[derive(Debug)]
pub struct RefineMetrics {
    hourly: Arc<HourlyStats>,
    jobs: Family<JobLabels, Counter>,
    job_seconds: Family<RefinerLabels, Histogram, fn() -> Histogram>,
    model_calls: Family<RefinerLabels, Counter>,
    cached_descriptions: Family<RefinerLabels, Counter>,
    tokens: Family<TokenLabels, Counter>,
    description_lookups: Family<LookupLabels, Counter>,
    in_progress: Gauge,
}

/// A job in progress; it is counted until this is dropped.
#[derive(Debug)]
pub struct CountedJob(Gauge);

impl Drop for CountedJob {
    fn drop(&mut self) {
        self.0.dec();
    }
}

/// The outcome of looking up a pair's description.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CacheLookup {
    /// It was cached.
    Hit,
    /// The description of a similar frame was cached.
    Similar,
    /// It had to be bought.
    Miss,
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
struct LookupLabels {
    result: &'static str,
}

impl RefineMetrics {
    /// Registers the metric families, with all counts at zero.
    pub fn register(registry: &mut Registry, hourly: Arc<HourlyStats>) -> Self {
        Self {
            hourly,
            jobs: register(registry, "jobs_ended", "Jobs that ended", Family::default()),
            job_seconds: register(
                registry,
                "job_seconds",
                "Time from a job's submission to its end",
                Family::new_with_constructor(latency),
            ),
            model_calls: register(
                registry,
                "model_calls",
                "Calls to an external model, by ended jobs",
                Family::default(),
            ),
            cached_descriptions: register(
                registry,
                "cached_descriptions",
                "Descriptions that an earlier job had paid for, by ended jobs",
                Family::default(),
            ),
            tokens: register(
                registry,
                "tokens",
                "Tokens sent to an external model (prompt) and received from it (completion)",
                Family::default(),
            ),
            description_lookups: register(
                registry,
                "description_lookups",
                "Lookups of a pair's description: cached (hit), cached for a nearly equal frame \
                 (similar), or bought (miss)",
                Family::default(),
            ),
            in_progress: register(
                registry,
                "jobs_in_progress",
                "Jobs that this process is refining",
                Gauge::default(),
            ),
        }
    }

    /// Counts a job that is in progress.
    pub fn job_begins(&self) -> CountedJob {
        self.in_progress.inc();
        CountedJob(self.in_progress.clone())
    }

    /// Returns the number of jobs in progress.
    pub fn jobs_in_progress(&self) -> usize {
        usize::try_from(self.in_progress.get()).unwrap_or_default()
    }

    /// Counts an ended job.
    pub fn job_ended(&self, job: &Job) {
        self.hourly.job_ended(Timestamp::now(), job.state == JobState::Failed);
        let refiner = job.refiner.as_str();
        self.jobs.get_or_create(&JobLabels { refiner, state: job.state.as_str() }).inc();
        let (labels, usage) = (RefinerLabels { refiner }, job.usage);
        self.model_calls.get_or_create(&labels).inc_by(usage.calls.into());
        self.cached_descriptions.get_or_create(&labels).inc_by(usage.cached.into());
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

    /// Counts a lookup of a pair's description.
    pub fn description_lookup(&self, found: CacheLookup) {
        let result = match found {
            CacheLookup::Hit => "hit",
            CacheLookup::Similar => "similar",
            CacheLookup::Miss => "miss",
        };
        self.description_lookups.get_or_create(&LookupLabels { result }).inc();
    }
}
