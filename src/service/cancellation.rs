//! When work for a caller is cancelled: at shutdown, at its deadline, or when its key is no longer valid.

use std::sync::Arc;
use std::time::Instant;

use super::{Principal, Readiness, Service, ServiceError};
use whereabouts_api::ErrorKind;

/// Time after which a caller no longer wants the answer, if it set one.
#[derive(Debug, Clone, Copy, Default)]
pub struct Deadline(pub Option<Instant>);

impl Service {
    /// Waits until the work of a caller must stop, and returns why: the server drains, its key is no longer valid,
    /// or its deadline has passed.
    pub fn cancelled_by(
        self: &Arc<Self>,
        readiness: &Readiness,
        caller: Principal,
        deadline: Deadline,
    ) -> impl Future<Output = ServiceError> + Send + use<> {
        let (service, draining) = (Arc::clone(self), readiness.draining());
        async move {
            let deadline = async {
                match deadline.0 {
                    Some(end) => tokio::time::sleep_until(end.into()).await,
                    None => std::future::pending().await,
                }
            };
            let (kind, detail) = tokio::select! {
                () = draining.cancelled() => {
                    (ErrorKind::Unavailable, "the server is shutting down; call again, another one may answer")
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
