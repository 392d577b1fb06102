//! The readiness gate between the server and the service: closed while the service starts, open, and draining at
//! shutdown. What a request does is for the use cases.

use std::sync::{Arc, OnceLock};

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::{Service, ServiceError};
use whereabouts_api::ErrorKind;

/// Phase of the server's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadinessPhase {
    /// The service is starting; requests are rejected.
    Starting,
    /// Requests are answered.
    Open,
    /// Requests in progress are finished; new ones should go to another server.
    Draining,
}

/// The gate through which requests reach the service. Clones share it.
#[derive(Clone)]
pub struct Readiness {
    service: Arc<OnceLock<Arc<Service>>>,
    phase: watch::Sender<ReadinessPhase>,
    draining: CancellationToken,
}

impl Default for Readiness {
    /// A gate that is closed until [`Readiness::open`].
    fn default() -> Self {
        Self {
            service: Arc::default(),
            phase: watch::Sender::new(ReadinessPhase::Starting),
            draining: CancellationToken::new(),
        }
    }
}

impl Readiness {
    /// Opens the gate to a service. Does nothing if it was opened before.
    pub fn open(&self, service: Arc<Service>) {
        if self.service.set(service).is_ok() {
            self.phase.send_replace(ReadinessPhase::Open);
        }
    }

    /// Reports the server as not ready from now on, and ends streams. Requests in progress are finished.
    pub fn drain(&self) {
        self.phase.send_replace(ReadinessPhase::Draining);
        self.draining.cancel();
    }

    /// A token that is cancelled when the drain begins.
    pub fn draining(&self) -> CancellationToken {
        self.draining.clone()
    }

    /// Watches the phase.
    pub fn phases(&self) -> watch::Receiver<ReadinessPhase> {
        self.phase.subscribe()
    }

    /// Returns the service; an error while it is starting.
    pub fn service(&self) -> Result<Arc<Service>, ServiceError> {
        self.service.get().cloned().ok_or_else(|| {
            let detail = "the server is starting; try again in a second";
            ServiceError::new(ErrorKind::Unavailable, detail)
        })
    }
}
