//! The way in: a service once there is one, and until it drains.

use std::sync::{Arc, OnceLock};
use whereabouts_api::ErrorKind;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::{Deadline, Principal, Service, ServiceError};

/// Whether requests are answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadinessPhase {
    /// Not yet.
    Starting,
    /// They are.
    Open,
    /// Those that were begun; new ones go to another server.
    Draining,
}

/// What stands between the callers and a service; clones share it.
#[derive(Clone)]
pub struct Readiness {
    service: Arc<OnceLock<Arc<Service>>>,
    phase: watch::Sender<ReadinessPhase>,
    draining: CancellationToken,
}

impl Default for Readiness {
    /// A door without a service behind it.
    fn default() -> Self {
        Self {
            service: Arc::default(),
            phase: watch::Sender::new(ReadinessPhase::Starting),
            draining: CancellationToken::new(),
        }
    }
}

impl Service {
    /// Ends when what a caller has begun is to be ended: the server drains, the caller may ask no more, or
    /// wants no more. Says why.
    pub fn cancelled_by(
        self: &Arc<Self>,
        door: &Readiness,
        caller: Principal,
        deadline: Deadline,
    ) -> impl Future<Output = ServiceError> + Send + use<> {
        let (service, draining) = (Arc::clone(self), door.draining());
        async move {
            let deadline = async {
                match deadline.0 {
                    Some(end) => tokio::time::sleep_until(end.into()).await,
                    None => std::future::pending().await,
                }
            };
            let (kind, detail) = tokio::select! {
                () = draining.cancelled() => {
                    (ErrorKind::Unavailable, "the server ends; call again, perhaps another one answers")
                }
                () = service.keys.ended(caller) => {
                    (ErrorKind::Unauthorized, "the key was revoked or has expired; ask an admin for another")
                }
                () = deadline => (ErrorKind::DeadlinePassed, "the deadline of the call has passed"),
            };
            ServiceError::new(kind, detail)
        }
    }
}

impl Readiness {
    /// Lets callers in.
    pub fn open(&self, service: Arc<Service>) {
        if self.service.set(service).is_ok() {
            self.phase.send_replace(ReadinessPhase::Open);
        }
    }

    /// Says from now on that the service is not ready, while it answers what it has begun. Streams end.
    pub fn drain(&self) {
        self.phase.send_replace(ReadinessPhase::Draining);
        self.draining.cancel();
    }

    /// Ends when the drain begins.
    pub fn draining(&self) -> CancellationToken {
        self.draining.clone()
    }

    /// The phase, and every change of it.
    pub fn phases(&self) -> watch::Receiver<ReadinessPhase> {
        self.phase.subscribe()
    }

    /// The service, once it is ready.
    pub fn service(&self) -> Result<Arc<Service>, ServiceError> {
        self.service.get().cloned().ok_or_else(|| {
            let detail = "the server is starting; try again in a second";
            ServiceError::new(ErrorKind::Unavailable, detail)
        })
    }
}
