//! What handlers share, and how a handler gets a service that is ready.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::problem::Problem;
use super::status::About;
use crate::Metrics;
use whereabouts_api::ErrorKind;
use whereabouts_service::Rejection;
use whereabouts_service::{Readiness, Service};

/// Bounds of the HTTP layer.
#[derive(Debug, Clone)]
pub struct HttpSettings {
    /// The largest body, in bytes.
    pub body_limit_bytes: usize,
    /// The most memory for all bodies but those of bulk uploads, in bytes.
    pub bodies_limit_bytes: usize,
    /// The most memory for the images of bulk uploads, in bytes.
    pub bulk_memory_bytes: usize,
    /// The longest time that a body takes.
    pub body_timeout: Duration,
    /// The longest pause within a body.
    pub body_pause: Duration,
    /// The longest request.
    pub request_timeout: Duration,
    /// By how much a request that waits for a job may take longer.
    pub max_wait: Duration,
    /// The most requests in progress.
    pub max_requests: usize,
    /// The most event streams that are open.
    pub max_streams: usize,
    /// The longest pause between two messages of a gRPC stream.
    pub stream_idle: Duration,
    /// Whether callers need a key.
    pub keys_required: bool,
}

/// Shared by all handlers; clones share it.
#[derive(Clone)]
pub struct AppState {
    pub(super) settings: Arc<HttpSettings>,
    pub(super) about: Arc<About>,
    pub(super) metrics: Arc<Metrics>,
    pub(super) permits: Arc<Semaphore>,
    pub(super) streams: Arc<Semaphore>,
    pub(super) bodies_memory: Arc<Semaphore>,
    pub(super) bulk_memory: Arc<Semaphore>,
    pub(super) door: Readiness,
}

impl AppState {
    /// A state without a service: every call but `/livez` answers 503 until there is one.
    pub fn new(settings: HttpSettings, about: About, metrics: Arc<Metrics>) -> Self {
        Self {
            permits: Arc::new(Semaphore::new(settings.max_requests)),
            streams: Arc::new(Semaphore::new(settings.max_streams)),
            bodies_memory: Arc::new(Semaphore::new(settings.bodies_limit_bytes)),
            bulk_memory: Arc::new(Semaphore::new(settings.bulk_memory_bytes)),
            settings: Arc::new(settings),
            about: Arc::new(about),
            metrics,
            door: Readiness::default(),
        }
    }

    #[cfg(test)]
    pub(super) fn for_tests(settings: HttpSettings) -> Self {
        let about = About {
            started_at: jiff::Timestamp::now(),
            settings: String::new(),
            pictures: 0,
            tiles: None,
            troubles: Arc::default(),
        };
        Self::new(settings, about, Arc::default())
    }

    /// What stands between the callers and the service.
    pub fn door(&self) -> &Readiness {
        &self.door
    }

    /// The right to one of the streams that may be open.
    pub(super) fn stream(&self) -> Result<OwnedSemaphorePermit, Problem> {
        Arc::clone(&self.streams).try_acquire_owned().map_err(|_| {
            self.metrics.refused(Rejection::Requests);
            let detail = format!(
                "{} streams are open, the bound (server.max_streams); ask with GET /jobs or \
                 GET /jobs/{{id}}?wait= instead",
                self.settings.max_streams
            );
            Problem::new(ErrorKind::Overloaded, detail)
        })
    }
}

/// The service, once it is ready.
pub(super) struct Ready(pub Arc<Service>);

impl FromRequestParts<AppState> for Ready {
    type Rejection = Problem;

    async fn from_request_parts(_: &mut Parts, state: &AppState) -> Result<Self, Problem> {
        Ok(Self(state.door.service()?))
    }
}
