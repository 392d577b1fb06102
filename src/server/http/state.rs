//! What the handlers of HTTP share.

use std::convert::Infallible;
use std::sync::Arc;

use axum::extract::{FromRef, FromRequestParts};
use axum::http::request::Parts;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::gate::Gate;
use whereabouts_service::Deadline;
use whereabouts_telemetry::LogIssues;

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

/// What `/status` reports that is fixed at startup.
#[derive(Debug)]
pub(crate) struct About {
    /// When the process started.
    pub started_at: Timestamp,
    /// Effective settings in TOML, without secrets.
    pub settings: String,
    /// Most pictures that may wait to be decoded.
    pub pictures: usize,
    /// The server of map tiles for the console, if one is configured.
    pub tiles: Option<Tiles>,
    /// Latest warnings and errors.
    pub troubles: Arc<LogIssues>,
}

/// A server of map tiles.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Tiles {
    /// URL template with `{z}`, `{x}` and `{y}` (Web Mercator, as OpenStreetMap uses).
    pub url: String,
    /// Attribution to show with the tiles.
    pub attribution: String,
}

/// Extracts the deadline that the gate has read; none if the client set none.
impl FromRequestParts<AppState> for Deadline {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &AppState) -> Result<Self, Infallible> {
        Ok(parts.extensions.get().copied().unwrap_or_default())
    }
}
