//! Gives each request an id, a trace span, a count and a log line.

use std::time::Instant;

use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use tracing::Instrument;

use super::audit::without_secrets;
use super::policy::policy;
use super::state::Gate;
use whereabouts_telemetry::traces;

/// The id of a request: the caller's `x-request-id`, or a generated one.
#[derive(Debug, Clone, Default)]
pub(super) struct RequestId(pub String);

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

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

/// The HTTP status of a response. A gRPC response, whose HTTP status is always 200, counts as the status
/// nearest to its code.
pub(super) fn status_of(response: &Response) -> u16 {
    #[cfg(feature = "grpc")]
    if let Some(status) = super::grpc_status::as_http(response) {
        return status;
    }
    response.status().as_u16()
}

fn request_id(request: &Request) -> RequestId {
    let usable = |text: &&str| {
        (1..=64).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic())
    };
    let sent = request.headers().get(REQUEST_ID).and_then(|value| value.to_str().ok());
    RequestId(match sent.filter(usable) {
        Some(id) => id.to_owned(),
        None => uuid::Uuid::now_v7().to_string(),
    })
}
