//! What handlers share, and how a handler gets a service that is ready.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;

use super::problem::Problem;
use crate::service::{ErrorKind, Service, ServiceError};
use crate::telemetry::Metrics;

/// Bounds of the HTTP layer.
#[derive(Debug, Clone)]
pub struct HttpSettings {
    /// The largest body, in bytes.
    pub body_limit_bytes: usize,
    /// The most memory for all bodies, in bytes.
    pub bodies_limit_bytes: usize,
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
    /// Whether callers need a key.
    pub keys_required: bool,
}

/// Shared by all handlers; clones share it.
#[derive(Clone)]
pub struct AppState {
    pub(super) settings: Arc<HttpSettings>,
    pub(super) metrics: Arc<Metrics>,
    pub(super) permits: Arc<Semaphore>,
    pub(super) streams: Arc<Semaphore>,
    pub(super) bodies_memory: Arc<Semaphore>,
    service: Arc<OnceLock<Arc<Service>>>,
    draining: CancellationToken,
}

impl AppState {
    /// A state without a service: every call but `/livez` answers 503 until there is one.
    pub fn new(settings: HttpSettings, metrics: Arc<Metrics>) -> Self {
        Self {
            permits: Arc::new(Semaphore::new(settings.max_requests)),
            streams: Arc::new(Semaphore::new(settings.max_streams)),
            bodies_memory: Arc::new(Semaphore::new(settings.bodies_limit_bytes)),
            settings: Arc::new(settings),
            metrics,
            service: Arc::default(),
            draining: CancellationToken::new(),
        }
    }

    /// Opens the doors.
    pub fn set_ready(&self, service: Arc<Service>) {
        let _ = self.service.set(service);
    }

    /// Says from now on that the server is not ready, while it answers what it has begun. Event
    /// streams end.
    pub fn set_draining(&self) {
        self.draining.cancel();
    }

    pub(super) fn is_draining(&self) -> bool {
        self.draining.is_cancelled()
    }

    pub(super) fn draining(&self) -> CancellationToken {
        self.draining.clone()
    }

    pub(super) fn service(&self) -> Result<Arc<Service>, ServiceError> {
        self.service.get().cloned().ok_or_else(|| {
            let detail = "the server is starting; try again in a second";
            ServiceError::new(ErrorKind::Unavailable, detail)
        })
    }
}

/// The service, once it is ready.
pub(super) struct Ready(pub Arc<Service>);

impl FromRequestParts<AppState> for Ready {
    type Rejection = Problem;

    async fn from_request_parts(_: &mut Parts, state: &AppState) -> Result<Self, Problem> {
        Ok(Self(state.service()?))
    }
}
