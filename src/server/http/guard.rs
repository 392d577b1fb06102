//! What every request passes: an id, a bound on how many, how large and how long, and a count.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::{Body, BodyDataStream};
use axum::extract::{MatchedPath, Request, State};
use axum::http::header::{CONNECTION, CONTENT_LENGTH, EXPECT};
use axum::http::{HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use http_body_util::BodyExt;
use tracing::Instrument;

use super::auth::without_secrets;
use super::batch;
use super::deadline;
use super::incoming::Watch;
use super::messages;
use super::problem::Problem;
use super::state::AppState;
use crate::grpc::{self, BodyBudget, Call, HEALTH_CHECK};
use whereabouts_api::ErrorKind;
use whereabouts_service::Deadline;
use whereabouts_service::Rejection;
use whereabouts_telemetry::traces;

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
    let path = without_secrets(request.uri().path());
    let span = traces::request(method.as_str(), &route, request.headers());
    let mut response = next.run(request).instrument(span.clone()).await;
    let (took, status) = (start.elapsed(), answered(&response));
    traces::answered(&span, status);
    state.metrics.request(method.as_str(), &route, status, took);
    tracing::debug!(request_id = %id.0, %method, path, status, ms = took.as_secs_f64() * 1e3);
    if let Ok(value) = HeaderValue::from_str(&id.0) {
        response.headers_mut().insert(REQUEST_ID, value);
    }
    response
}

/// What a request was answered with; of a call of gRPC, whose status of HTTP is always 200, what comes
/// nearest to it.
pub(super) fn answered(response: &Response) -> u16 {
    grpc::status::as_http(response).unwrap_or(response.status().as_u16())
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
pub(super) async fn bound(
    State(state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    let arrival = Instant::now();
    let call = grpc::call(request.uri().path());
    if call.is_some() && !grpc::is_call(request.headers()) {
        let detail = "this is a call of gRPC, whose Content-Type is application/grpc; GET /docs lists the calls \
                      of HTTP";
        return refuse(request, ErrorKind::UnsupportedMedia, detail.into());
    }
    // An operator looks here when the server is overloaded.
    match (request.uri().path(), call) {
        ("/livez" | "/readyz" | "/metrics", _) => return next.run(request).await,
        (HEALTH_CHECK, Some(call)) => {
            let bounded = |body| messages::bounded(body, call, &state, BodyBudget::default());
            return next.run(request.map(bounded)).await;
        }
        _ => {}
    }
    let route = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
    if call.is_some_and(|call| call.streams) || route == Some(batch::PATH) {
        return bound_stream(state, request, next, arrival, call).await;
    }
    let Ok(_permit) = Arc::clone(&state.permits).try_acquire_owned() else {
        state.metrics.refused(Rejection::Requests);
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
    let wanted_for = match deadline::allowed(request.headers()) {
        Ok(wanted_for) => wanted_for,
        Err(problem) => return problem.into_response(),
    };
    request.extensions_mut().insert(Deadline(wanted_for.map(|wait| arrival + wait)));
    let watch = Watch::default();
    let request = request.map(|body| match call {
        Some(call) => messages::bounded(body, call, &state, watch.held.clone()),
        None => watch.over(body, &state.settings, &state.bodies_memory),
    });
    let longest = time_allowed(&state, &request, call);
    let allowed = wanted_for.map_or(longest, |wait| wait.min(longest));
    let answered = tokio::time::timeout(allowed, next.run(request)).await;
    watch.held.answered();
    if let Some((problem, reason)) = watch.problem() {
        state.metrics.refused(reason);
        return hanging_up(problem);
    }
    match (answered, wanted_for) {
        (Ok(response), _) => response,
        (Err(_), Some(wait)) if wait <= longest => {
            state.metrics.refused(Rejection::Deadline);
            deadline::passed(wait).into_response()
        }
        (Err(_), _) => Problem::new(
            ErrorKind::Unavailable,
            format!("the request took longer than {} s; try again", longest.as_secs()),
        )
        .into_response(),
    }
}

/// Bounds a request that may take any time, message by message, or piece by piece.
async fn bound_stream(
    state: AppState,
    mut request: Request,
    next: Next,
    arrival: Instant,
    call: Option<Call>,
) -> Response {
    let (permit, wait) = match (state.stream(), deadline::allowed(request.headers())) {
        (Ok(permit), Ok(wait)) => (permit, wait),
        (Err(problem), _) | (_, Err(problem)) => {
            throw_away(request);
            return hanging_up(problem);
        }
    };
    let held = BodyBudget::default();
    request.extensions_mut().insert(Deadline(wait.map(|wait| arrival + wait)));
    request.extensions_mut().insert(held.clone());
    let request = request.map(|body| match call {
        Some(call) => messages::bounded(body, call, &state, held.clone()),
        None => batch::unhurried(body, state.settings.body_pause),
    });
    let mut response = next.run(request).await;
    // What was refused, and what is answered once, has been answered.
    if call.is_none_or(|call| call.many) || grpc::status::as_http(&response).is_some() {
        held.answered();
    }
    if call.is_none() && !response.status().is_success() {
        response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    }
    response.map(|body| {
        Body::new(body.map_frame(move |frame| {
            // Given back when the answers end or the client has gone.
            let _permit = &permit;
            frame
        }))
    })
}

pub(super) fn too_large(limit: usize) -> String {
    format!("the body exceeds {limit} bytes (server.body_limit_bytes); send a smaller picture")
}

fn time_allowed(state: &AppState, request: &Request, call: Option<Call>) -> Duration {
    let waits = match call {
        Some(call) => call.waits,
        None => request.uri().query().is_some_and(|query| query.contains("wait")),
    };
    state.settings.request_timeout + if waits { state.settings.max_wait } else { Duration::ZERO }
}

/// Answers without reading the body.
fn refuse(request: Request, kind: ErrorKind, detail: String) -> Response {
    throw_away(request);
    hanging_up(Problem::new(kind, detail))
}

/// Gives a request up. What the client is still sending is thrown away for a while, or it would see a
/// reset connection instead of the answer; who asks before it sends is not told to.
pub(super) fn throw_away(request: Request) {
    if !request.headers().contains_key(EXPECT) {
        tokio::spawn(discard(request.into_body().into_data_stream()));
    }
}

/// The answer after which the connection is closed.
pub(super) fn hanging_up(problem: Problem) -> Response {
    let mut response = problem.into_response();
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
