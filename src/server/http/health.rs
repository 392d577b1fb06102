//! Liveness, readiness, metrics, and the description of the API.

use axum::Json;
use axum::extract::State;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::response::{Html, IntoResponse, Response};

use super::state::AppState;
use crate::gate::Problem;
use crate::gate::Ready;
use crate::{Levels, Metrics};
use whereabouts_api::ErrorKind;
use whereabouts_service::{Service, ServiceError};

/// Whether the process runs
#[utoipa::path(get, path = "/livez", tag = "service", responses((status = 200, body = String)))]
pub(super) async fn livez() -> &'static str {
    "alive\n"
}

/// Whether requests are accepted
#[utoipa::path(get, path = "/readyz", tag = "service", responses(
    (status = 200, body = String),
    (status = 503, body = Problem, description = "Starting or draining", content_type = "application/problem+json"),
))]
pub(super) async fn readyz(State(state): State<AppState>) -> Result<&'static str, Problem> {
    state.gate.readiness.service()?;
    if state.gate.readiness.draining().is_cancelled() {
        return Err(Problem::new(ErrorKind::Unavailable, "the server is draining; use another"));
    }
    Ok("ready\n")
}

/// Metrics for Prometheus
#[utoipa::path(get, path = "/metrics", tag = "service", responses(
    (status = 200, body = String, content_type = "application/openmetrics-text"),
))]
pub(super) async fn metrics(
    State(state): State<AppState>,
    Ready(service): Ready,
) -> Result<impl IntoResponse, Problem> {
    const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    let text = metrics_text(&state.gate.metrics, &service).await?;
    Ok(([(CONTENT_TYPE, OPEN_METRICS)], text))
}

pub(super) async fn openapi_json(description: utoipa::openapi::OpenApi) -> Response {
    Json(description).into_response()
}

/// The page that renders `/openapi.json`. It loads nothing from elsewhere.
pub(super) async fn docs() -> impl IntoResponse {
    const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src \
                          'unsafe-inline'; connect-src 'self'";
    ([(CONTENT_SECURITY_POLICY, POLICY)], Html(include_str!("docs.html")))
}

/// Encodes all metrics, with gauges as of now.
async fn metrics_text(metrics: &Metrics, service: &Service) -> Result<String, ServiceError> {
    let maps = service.list_maps().await?.into_iter();
    let index_bytes = service.retention.index_bytes().await?.into_iter();
    metrics.set_levels(&Levels {
        maps: maps.map(|map| (map.name.to_string(), map.images)).collect(),
        index_bytes: index_bytes.map(|(map, bytes)| (map.to_string(), bytes)).collect(),
        queued: service.jobs.queued().await?,
        oldest_job: service.age_of_oldest_job().await?,
        waiting_deliveries: service.webhooks.store.waiting_deliveries().await?,
        db_bytes: service.retention.db_bytes().await?,
        dense_cache_bytes: service.dense.bytes(),
        admission: service.admission.levels(),
        mllm: service.refiner.as_ref().and_then(|refiner| Some(refiner.paid_calls()?.levels())),
    });
    metrics.encode().map_err(|error| ServiceError::new(ErrorKind::Internal, error.to_string()))
}
