//! Metric families of the use cases: stages of localization, recall checks, retention and webhooks.

use std::sync::Arc;
use std::time::Duration;

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use whereabouts_store::RemovedJobs;
use whereabouts_telemetry::metrics::{Registry, latency, register};
use whereabouts_vision::{Extraction, Uninformative};

use crate::rejections::Rejections;

/// Metric families of the use cases.
#[derive(Debug)]
pub struct ServiceMetrics {
    /// Rejections, by reason.
    pub refusals: Arc<Rejections>,
    stage_seconds: Family<StageLabels, Histogram, fn() -> Histogram>,
    batch_pictures: Histogram,
    neighbours_checked: Family<CheckLabels, Counter>,
    submitted_jobs: Counter,
    removed_jobs: Family<RemovedLabels, Counter>,
    removed_frame_bytes: Counter,
    uninformative_frames: Family<WhyLabels, Counter>,
    damaged_pictures: Counter,
    webhook_attempts: Family<OutcomeLabels, Counter>,
    images_read: Family<OutcomeLabels, Counter>,
    lines_read: Counter,
    images_unread: Family<MapLabels, Gauge>,
    read_seconds: Histogram,
}

/// The outcome of an attempt to deliver a message to a webhook.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptOutcome {
    /// The receiver accepted it.
    Delivered,
    /// It will be retried.
    Failed,
    /// It will not be retried.
    Dead,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct StageLabels {
    stage: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RemovedLabels {
    why: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct CheckLabels {
    map: String,
    found: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct WhyLabels {
    why: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct MapLabels {
    map: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OutcomeLabels {
    outcome: &'static str,
}

impl ServiceMetrics {
    /// Registers the families.
    pub fn register(registry: &mut Registry, refusals: Arc<Rejections>) -> Self {
        Self {
            refusals,
            stage_seconds: register(
                registry,
                "stage_seconds",
                "Time in one stage of localizing or indexing a picture",
                Family::new_with_constructor(latency),
            ),
            batch_pictures: register(
                registry,
                "batch_pictures",
                "Size of the inference batch of each picture",
                Histogram::new(exponential_buckets(1.0, 2.0, 7)),
            ),
            neighbours_checked: register(
                registry,
                "neighbours_checked",
                "Nearest images by exact search of the frames whose search was checked (index.check_s), by \
                 whether the index had found them",
                Family::default(),
            ),
            submitted_jobs: register(registry, "jobs_submitted", "Jobs queued", Counter::default()),
            removed_jobs: register(
                registry,
                "jobs_removed",
                "Ended jobs that were removed, by reason: their age, or their number (count)",
                Family::default(),
            ),
            removed_frame_bytes: register(
                registry,
                "frame_bytes_removed",
                "Bytes of frames removed with their jobs",
                Counter::default(),
            ),
            uninformative_frames: register(
                registry,
                "uninformative_frames",
                "Frames that cannot show a known place, by reason: blank, noise, blurred, pattern or incomplete",
                Family::default(),
            ),
            damaged_pictures: register(
                registry,
                "damaged_pictures",
                "Pictures that were decoded although bytes were missing or changed",
                Counter::default(),
            ),
            webhook_attempts: register(
                registry,
                "webhook_attempts",
                "Attempts to deliver a message to a webhook: delivered, failed (will be retried) or dead \
                 (will not be retried)",
                Family::default(),
            ),
            images_read: register(
                registry,
                "images_read",
                "Images whose text was read, by outcome: read, or failed (will not be tried again)",
                Family::default(),
            ),
            lines_read: register(
                registry,
                "lines_read",
                "Lines of text that were read in images",
                Counter::default(),
            ),
            images_unread: register(
                registry,
                "images_unread",
                "Images of a map whose text is not read yet",
                Family::default(),
            ),
            read_seconds: register(
                registry,
                "read_seconds",
                "Time from the decision to read an image until its text was known",
                Histogram::new(exponential_buckets(0.05, 2.0, 10)),
            ),
        }
    }

    /// Observes the stages of an extraction.
    pub fn observe_extraction(&self, extraction: &Extraction) {
        self.batch_pictures.observe(extraction.batch as f64);
        self.count_damage(&extraction.warnings);
        let times = extraction.times;
        for (stage, time) in [("decode", times.decode), ("extract", times.extract)] {
            self.stage_seconds.get_or_create(&StageLabels { stage }).observe(time.as_secs_f64());
        }
    }

    /// Counts a picture that was decoded with warnings.
    pub fn count_damage(&self, warnings: &[String]) {
        if !warnings.is_empty() {
            self.damaged_pictures.inc();
        }
    }

    /// Observes the duration of a search.
    pub fn observe_search(&self, took: Duration) {
        let stage = StageLabels { stage: "search" };
        self.stage_seconds.get_or_create(&stage).observe(took.as_secs_f64());
    }

    /// Counts the nearest images of a frame whose search was checked, and how many of them it had found.
    pub fn search_checked(&self, map: &str, nearest: usize, found: usize) {
        for (word, count) in [("yes", found), ("no", nearest.saturating_sub(found))] {
            let labels = CheckLabels { map: map.to_owned(), found: word };
            self.neighbours_checked.get_or_create(&labels).inc_by(count as u64);
        }
    }

    /// Counts a frame that cannot show a known place.
    pub fn uninformative_frame(&self, why: Uninformative) {
        self.uninformative_frames.get_or_create(&WhyLabels { why: why.word() }).inc();
    }

    /// Counts a queued job.
    pub fn job_submitted(&self) {
        self.submitted_jobs.inc();
    }

    /// Counts jobs that the janitor removed.
    pub fn jobs_removed(&self, removed: &RemovedJobs) {
        for (why, jobs) in [("age", removed.by_age), ("count", removed.by_count)] {
            self.removed_jobs.get_or_create(&RemovedLabels { why }).inc_by(jobs as u64);
        }
        self.removed_frame_bytes.inc_by(removed.bytes);
    }

    /// Counts an image that was read or could not be.
    pub fn image_read(&self, succeeded: bool, lines: usize, took: Duration) {
        let outcome = if succeeded { "read" } else { "failed" };
        self.images_read.get_or_create(&OutcomeLabels { outcome }).inc();
        self.lines_read.inc_by(lines as u64);
        self.read_seconds.observe(took.as_secs_f64());
    }

    /// Shows how many images of a map are not read yet.
    pub fn images_unread(&self, map: &str, images: usize) {
        let labels = MapLabels { map: map.to_owned() };
        self.images_unread.get_or_create(&labels).set(i64::try_from(images).unwrap_or(i64::MAX));
    }

    /// Forgets how many images of a map are not read, since it is gone.
    pub fn forget_images_unread(&self, map: &str) {
        self.images_unread.remove(&MapLabels { map: map.to_owned() });
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
}
