//! What every request passes: an id, a bound on how many, how large and how long, and a count.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::BodyDataStream;
use axum::extract::{MatchedPath, Request, State};
use axum::http::header::{CONNECTION, CONTENT_LENGTH};
use axum::http::{HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;

use super::problem::Problem;
use super::state::AppState;
use crate::service::ErrorKind;

/// The id of a request: the caller's `x-request-id`, or a fresh one.
#[derive(Debug, Clone, Default)]
pub(super) struct RequestId(pub String);

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// Gives the request an id, counts it, and logs it.
pub(super) async fn observe(
    State(state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    let start = Instant::now();
    let id = request_id(&request);
    request.extensions_mut().insert(id.clone());
    let method = request.method().clone();
    // The pattern, not the path: a label for every image id would be a leak.
    let route =
        request.extensions().get::<MatchedPath>().map_or("none", |path| path.as_str()).to_owned();
    let path = request.uri().path().to_owned();
    let mut response = next.run(request).await;
    let (took, status) = (start.elapsed(), response.status().as_u16());
    state.metrics.request(method.as_str(), &route, status, took);
    tracing::debug!(request_id = %id.0, %method, path, status, ms = took.as_secs_f64() * 1e3);
    if let Ok(value) = HeaderValue::from_str(&id.0) {
        response.headers_mut().insert(REQUEST_ID, value);
    }
    response
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

/// Bounds how many requests are in progress, how large they are and how long they take.
pub(super) async fn bound(State(state): State<AppState>, request: Request, next: Next) -> Response {
    // An operator looks here when the server is overloaded.
    if matches!(request.uri().path(), "/livez" | "/readyz" | "/metrics") {
        return next.run(request).await;
    }
    let Ok(_permit) = Arc::clone(&state.permits).try_acquire_owned() else {
        let detail = format!(
            "{} requests are in progress, the bound (server.max_requests); try again in a moment",
            state.settings.max_requests
        );
        return refuse(request, ErrorKind::Overloaded, detail);
    };
    let length = request.headers().get(CONTENT_LENGTH).and_then(|value| value.to_str().ok());
    let limit = state.settings.body_limit_bytes;
    if length.and_then(|length| length.parse::<u64>().ok()).is_some_and(|n| n > limit as u64) {
        return refuse(request, ErrorKind::TooLarge, too_large(limit));
    }
    let allowed = time_allowed(&state, &request);
    match tokio::time::timeout(allowed, next.run(request)).await {
        Ok(response) => response,
        Err(_) => Problem::new(
            ErrorKind::Unavailable,
            format!("the request took longer than {} s; try again", allowed.as_secs()),
        )
        .into_response(),
    }
}

pub(super) fn too_large(limit: usize) -> String {
    format!("the body exceeds {limit} bytes (server.body_limit_bytes); send a smaller picture")
}

fn time_allowed(state: &AppState, request: &Request) -> Duration {
    let waits = request.uri().query().is_some_and(|query| query.contains("wait"));
    state.settings.request_timeout + if waits { state.settings.max_wait } else { Duration::ZERO }
}

/// Answers without reading the body. What the client is still sending is thrown away for a while,
/// or it would see a reset connection instead of the answer.
fn refuse(request: Request, kind: ErrorKind, detail: String) -> Response {
    tokio::spawn(discard(request.into_body().into_data_stream()));
    let mut response = Problem::new(kind, detail).into_response();
    response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    response
}

pub(super) async fn discard(mut chunks: BodyDataStream) {
    const LONGEST: Duration = Duration::from_secs(5);
    let _ = tokio::time::timeout(
        LONGEST,
        async move { while let Some(Ok(_)) = chunks.next().await {} },
    )
    .await;
}
