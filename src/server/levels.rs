//! Gauges that are read when the metrics are scraped.

use std::sync::atomic::AtomicU64;
use std::time::Duration;

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use whereabouts_telemetry::metrics::Registry;

use whereabouts_refine::PaidCallLevels;
use whereabouts_telemetry::metrics::register;
use whereabouts_vision::AdmissionLevels;

/// Values of the gauges at one scrape.
#[derive(Debug, Clone)]
pub struct Levels {
    /// Number of images of each map.
    pub maps: Vec<(String, usize)>,
    /// Size of each map's descriptors and index, in bytes.
    pub index_bytes: Vec<(String, u64)>,
    /// Jobs queued or running.
    pub queued: usize,
    /// Age of the oldest of them; zero if there is none.
    pub oldest_job: Duration,
    /// Webhook deliveries that are queued.
    pub waiting_deliveries: usize,
    /// Size of the database files, in bytes.
    pub db_bytes: u64,
    /// Size of the cached dense features, in bytes.
    pub dense_cache_bytes: usize,
    /// Pictures in progress and waiting.
    pub admission: AdmissionLevels,
    /// State of the MLLM client, if the refiner uses one.
    pub mllm: Option<PaidCallLevels>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct MapLabels {
    map: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct ClassLabels {
    class: &'static str,
}

/// The gauges, as set at the last scrape.
#[derive(Debug)]
pub(super) struct Gauges {
    queued_jobs: Gauge,
    oldest_job_seconds: Gauge<f64, AtomicU64>,
    db_bytes: Gauge,
    description_cache_entries: Gauge,
    description_cache_bytes: Gauge,
    mllm_suspended: Gauge,
    mllm_tokens_today: Gauge,
    mllm_money_today: Gauge<f64, AtomicU64>,
    mllm_calls_in_flight: Gauge,
    mllm_calls_limit: Gauge,
    map_images: Family<MapLabels, Gauge>,
    index_bytes: Family<MapLabels, Gauge>,
    dense_cache_bytes: Gauge<f64, AtomicU64>,
    permits: Gauge,
    permits_in_use: Gauge,
    waiting: Family<ClassLabels, Gauge>,
    waiting_deliveries: Gauge,
}

impl Gauges {
    pub fn new(registry: &mut Registry) -> Self {
        Self {
            queued_jobs: register(
                registry,
                "jobs_queued",
                "Jobs queued or running",
                Gauge::default(),
            ),
            oldest_job_seconds: register(
                registry,
                "oldest_job_seconds",
                "Age of the oldest job queued or running; 0 if there is none",
                Gauge::default(),
            ),
            db_bytes: register(
                registry,
                "db_bytes",
                "Size of the database files",
                Gauge::default(),
            ),
            description_cache_entries: register(
                registry,
                "description_cache_entries",
                "Cached descriptions",
                Gauge::default(),
            ),
            description_cache_bytes: register(
                registry,
                "description_cache_bytes",
                "Size of the cached descriptions",
                Gauge::default(),
            ),
            mllm_suspended: register(
                registry,
                "mllm_suspended",
                "Whether calls to the MLLM are suspended after repeated failures",
                Gauge::default(),
            ),
            mllm_tokens_today: register(
                registry,
                "mllm_tokens_today",
                "Tokens spent since midnight UTC, calls in progress included",
                Gauge::default(),
            ),
            mllm_money_today: register(
                registry,
                "mllm_money_today",
                "Money spent since midnight UTC, calls in progress included",
                Gauge::default(),
            ),
            mllm_calls_in_flight: register(
                registry,
                "mllm_calls_in_flight",
                "Calls to the MLLM that are sent and not answered",
                Gauge::default(),
            ),
            mllm_calls_limit: register(
                registry,
                "mllm_calls_limit",
                "Calls to the MLLM that are made at once at most, which follows what the server bears",
                Gauge::default(),
            ),
            map_images: register(registry, "map_images", "Images in a map", Family::default()),
            index_bytes: register(
                registry,
                "index_bytes",
                "Size of the descriptors and index of a map",
                Family::default(),
            ),
            dense_cache_bytes: register(
                registry,
                "dense_cache_bytes",
                "Memory held by cached dense features",
                Gauge::default(),
            ),
            permits: register(
                registry,
                "permits",
                "Pictures that may be decoded and inferred concurrently",
                Gauge::default(),
            ),
            permits_in_use: register(
                registry,
                "permits_in_use",
                "Pictures being decoded and inferred",
                Gauge::default(),
            ),
            waiting: register(
                registry,
                "pictures_waiting",
                "Pictures waiting for a permit, by class of work",
                Family::default(),
            ),
            waiting_deliveries: register(
                registry,
                "webhook_deliveries_waiting",
                "Webhook deliveries queued",
                Gauge::default(),
            ),
        }
    }

    pub fn set(&self, levels: &Levels) {
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
            self.mllm_calls_in_flight.set(mllm.calls_in_flight as i64);
            self.mllm_calls_limit.set(mllm.calls_at_once as i64);
            self.description_cache_entries.set(mllm.cache.entries as i64);
            self.description_cache_bytes.set(mllm.cache.bytes as i64);
        }
    }
}

/// Sets the gauge of each map, and removes those of deleted maps.
fn set_of_maps<'a>(
    family: &Family<MapLabels, Gauge>,
    levels: impl Iterator<Item = (&'a String, i64)>,
) {
    family.clear();
    for (map, level) in levels {
        family.get_or_create(&MapLabels { map: map.clone() }).set(level);
    }
}
