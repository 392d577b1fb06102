//! What the handlers of HTTP share.

use std::convert::Infallible;
use std::sync::Arc;

use axum::extract::{FromRef, FromRequestParts};
use axum::http::request::Parts;

use super::status::About;
use crate::gate::Gate;
use whereabouts_service::Deadline;

/// The state of all handlers. Clones share it.
#[derive(Clone)]
pub(crate) struct AppState {
    /// The gate in front of the handlers.
    pub gate: Gate,
    /// What `/status` says about the process.
    pub about: Arc<About>,
}

impl FromRef<AppState> for Gate {
    fn from_ref(state: &AppState) -> Self {
        state.gate.clone()
    }
}

/// Extracts the deadline that the gate has read; none if the client set none.
impl FromRequestParts<AppState> for Deadline {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &AppState) -> Result<Self, Infallible> {
        Ok(parts.extensions.get().copied().unwrap_or_default())
    }
}
