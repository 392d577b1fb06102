//! Gives each request an id, a trace span, a count and a log line.

use std::time::Instant;

use axum::extract::{MatchedPath, Request, State};
use axum::http::HeaderValue;
use axum::middleware::Next;
use axum::response::Response;
use tracing::Instrument;

use super::audit::without_secrets;
use super::policy::policy;
use super::request_id::{REQUEST_ID, request_id};
use super::state::Gate;
use super::status::status_of;
use whereabouts_telemetry::traces;

/// Gives the request an id, counts it, and logs it.
pub(super) async fn observe(
    State(gate): State<Gate>,
    mut request: Request,
    next: Next,
) -> Response {
    let start = Instant::now();
    let id = request_id(&request);
    request.extensions_mut().insert(id.clone());
    let method = request.method().clone();
    // The pattern, not the path: a label for every image id would grow without bound.
    let route =
        request.extensions().get::<MatchedPath>().map_or("none", |path| path.as_str()).to_owned();
    let localizes = policy(&request).is_some_and(|policy| policy.localizes);
    let path = without_secrets(request.uri().path());
    let span = traces::request(method.as_str(), &route, request.headers());
    let mut response = next.run(request).instrument(span.clone()).await;
    let (took, status) = (start.elapsed(), status_of(&response));
    traces::answered(&span, status);
    gate.metrics.request(method.as_str(), &route, status, took, localizes);
    tracing::debug!(request_id = %id.0, %method, path, status, ms = took.as_secs_f64() * 1e3);
    if let Ok(value) = HeaderValue::from_str(&id.0) {
        response.headers_mut().insert(REQUEST_ID, value);
    }
    response
}
