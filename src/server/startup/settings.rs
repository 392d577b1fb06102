//! From the configuration to the settings of the use cases.

use std::time::Duration;

use whereabouts_core::CalibrationSettings;
use whereabouts_refine::AttemptPolicy;
use whereabouts_service::{
    IdempotencySettings, LocalizeSettings, RetentionSettings, ServiceSettings,
};

use crate::config::Config;
use crate::gate::GateSettings;

/// Bounds and defaults of the use cases.
pub fn service(config: &Config) -> ServiceSettings {
    ServiceSettings {
        localize: LocalizeSettings {
            k: config.localize.k,
            max_k: config.localize.max_k,
            compared: config.compared_candidates(),
            known_confidence: config.localize.known_confidence,
        },
        track: config.track.clone(),
        calibration: CalibrationSettings {
            images: config.confidence.images,
            refined: config.confidence.refined,
            candidates: config.compared_candidates(),
            place_images: config.confidence.place_images,
            place_m: config.confidence.place_m,
        },
        job_queue: config.jobs.queue,
        shed_jobs_at: config.jobs.shed_at,
        max_wait: Duration::from_secs(config.jobs.max_wait_s),
        recall_check: Some(Duration::from_secs(config.index.check_s))
            .filter(|pause| !pause.is_zero()),
        usage_days: config.data.usage_days,
        idempotency: idempotency(config),
        bulk: config.bulk,
        webhooks: config.webhooks.clone(),
    }
}

/// Bounds on connections, bodies and requests.
pub fn gate(config: &Config) -> GateSettings {
    GateSettings {
        body_limit_bytes: config.server.body_limit_bytes,
        bodies_limit_bytes: config.server.bodies_limit_bytes,
        body_timeout: Duration::from_secs(config.server.body_timeout_s),
        body_pause: Duration::from_secs(config.server.body_pause_s),
        request_timeout: config.server.request_timeout(),
        max_wait: Duration::from_secs(config.jobs.max_wait_s),
        max_requests: config.server.max_requests,
        max_streams: config.server.max_streams,
        stream_idle: Duration::from_secs(config.server.stream_idle_s),
        bulk_memory_bytes: config.bulk.memory_bytes,
        keys_required: config.keys_required(),
    }
}

/// What is kept, and for how long.
pub fn retention(config: &Config) -> RetentionSettings {
    let keep = Duration::from_secs(u64::from(config.jobs.keep_days) * 24 * 3600);
    RetentionSettings {
        keep: Some(keep).filter(|keep| !keep.is_zero()),
        most: Some(config.jobs.keep_count).filter(|most| *most > 0),
        settle: Duration::from_secs(config.jobs.max_wait_s),
        pause: Duration::from_secs(config.jobs.sweep_s),
        batch: config.jobs.sweep_batch,
        usage_days: config.data.usage_days,
        idempotency: idempotency(config),
    }
}

fn idempotency(config: &Config) -> IdempotencySettings {
    IdempotencySettings {
        keep: Duration::from_secs(u64::from(config.idempotency.keep_hours) * 3600),
        most: config.idempotency.max,
    }
}

/// How often a refinement is attempted.
pub fn attempts(config: &Config) -> AttemptPolicy {
    AttemptPolicy {
        attempts: config.jobs.attempts,
        pause: Duration::from_secs(config.jobs.retry_pause_s),
        longest_pause: Duration::MAX,
    }
}
