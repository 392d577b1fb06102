//! What all layers of the gate share, and how a handler gets the service behind it.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::{FromRef, FromRequestParts};
use axum::http::request::Parts;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::problem::Problem;
use super::settings::ServerSettings;
use crate::Metrics;
use whereabouts_api::ErrorKind;
use whereabouts_service::{Readiness, Rejection, Service};

/// Bounds on requests.
#[derive(Debug, Clone)]
pub struct GateSettings {
    /// Bounds of the server.
    pub server: ServerSettings,
    /// Added to the longest time of a request for one that waits for a job.
    pub max_wait: Duration,
    /// Memory for the images of bulk uploads in progress, in bytes.
    pub bulk_memory_bytes: usize,
    /// Whether callers need a key.
    pub keys_required: bool,
}

/// The state of the gate. Clones share it.
#[derive(Clone)]
pub struct Gate {
    pub(crate) settings: Arc<GateSettings>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) readiness: Readiness,
    /// One permit for each request in progress.
    pub(super) requests: Arc<Semaphore>,
    /// One permit for each open stream.
    streams: Arc<Semaphore>,
    /// One permit for each byte of the bodies in progress.
    pub(super) bodies_memory: Arc<Semaphore>,
    /// The same for bulk uploads.
    pub(crate) bulk_memory: Arc<Semaphore>,
}

impl Gate {
    /// A gate with no service behind it yet: until there is one, every call except `/livez` answers 503.
    pub fn new(settings: GateSettings, metrics: Arc<Metrics>) -> Self {
        Self {
            requests: Arc::new(Semaphore::new(settings.server.max_requests)),
            streams: Arc::new(Semaphore::new(settings.server.max_streams)),
            bodies_memory: Arc::new(Semaphore::new(settings.server.bodies_limit_bytes)),
            bulk_memory: Arc::new(Semaphore::new(settings.bulk_memory_bytes)),
            settings: Arc::new(settings),
            metrics,
            readiness: Readiness::default(),
        }
    }

    /// Whether the service is starting, open or draining.
    pub fn readiness(&self) -> &Readiness {
        &self.readiness
    }

    /// A permit to keep a stream open.
    pub(crate) fn stream_permit(&self) -> Result<OwnedSemaphorePermit, Problem> {
        Arc::clone(&self.streams).try_acquire_owned().map_err(|_| {
            self.metrics.refused(Rejection::Requests);
            let detail = format!(
                "{} streams are open, the limit (server.max_streams); poll GET /jobs or \
                 GET /jobs/{{id}}?wait= instead",
                self.settings.server.max_streams
            );
            Problem::new(ErrorKind::Overloaded, detail)
        })
    }
}

#[cfg(test)]
impl GateSettings {
    /// Bounds that allow next to nothing.
    pub(crate) fn small() -> Self {
        Self {
            server: ServerSettings {
                body_limit_bytes: 100,
                bodies_limit_bytes: 250,
                body_timeout: Duration::from_secs(1),
                body_pause: Duration::from_millis(60),
                request_timeout: Duration::from_millis(200),
                max_requests: 1,
                max_streams: 1,
                stream_idle: Duration::from_millis(60),
                ..crate::config::defaults().server
            },
            max_wait: Duration::from_secs(1),
            bulk_memory_bytes: 150,
            keys_required: false,
        }
    }
}

/// The problem of a bulk upload whose images found no memory in time.
pub(crate) fn no_bulk_memory() -> Problem {
    let detail = "uploads in progress fill the memory for their images (bulk.memory_bytes); try again in a \
                  moment";
    Problem::new(ErrorKind::Overloaded, detail)
}

/// Extracts the service; answers 503 while there is none.
pub(crate) struct Ready(pub Arc<Service>);

impl<S: Send + Sync> FromRequestParts<S> for Ready
where
    Gate: FromRef<S>,
{
    type Rejection = Problem;

    async fn from_request_parts(_: &mut Parts, state: &S) -> Result<Self, Problem> {
        Ok(Self(Gate::from_ref(state).readiness.service()?))
    }
}
