//! Bounds on requests: how many are in progress, how large they are, and how long they take.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::HeaderValue;
use axum::http::header::{CONNECTION, CONTENT_LENGTH};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use http_body_util::BodyExt;
use tokio::time::timeout;

use super::body::{closing, drained, refuse, too_large};
use super::body_budget::BodyBudget;
use super::incoming::BodyWatch;
use super::policy::{RoutePolicy, policy};
use super::problem::{Problem, is_grpc};
use super::state::Gate;
use super::{deadline, encoding, upload};
use whereabouts_api::ErrorKind;
use whereabouts_service::{Deadline, Rejection};

/// Bounds a request as the policy of its route says.
pub(super) async fn bound(State(gate): State<Gate>, mut request: Request, next: Next) -> Response {
    let arrival = Instant::now();
    let policy = policy(&request);
    if policy.is_some_and(|policy| policy.is_grpc()) && !is_grpc(request.headers()) {
        let detail = "this is a gRPC call, which needs the Content-Type application/grpc; GET /docs lists the \
                      HTTP calls";
        return refuse(request, Problem::new(ErrorKind::UnsupportedMedia, detail));
    }
    if let Some(policy) = policy.filter(|policy| policy.probe) {
        if policy.is_grpc() {
            request = request.map(|body| messages(body, policy, &gate, &BodyBudget::default()));
        }
        return next.run(request).await;
    }
    if let Some(policy) = policy.filter(|policy| policy.streams) {
        return bound_stream(&gate, request, next, arrival, policy).await;
    }
    let Ok(_permit) = Arc::clone(&gate.requests).try_acquire_owned() else {
        gate.metrics.refused(Rejection::Requests);
        let detail = format!(
            "{} requests are in progress, the limit (server.max_requests); try again in a moment",
            gate.settings.server.max_requests
        );
        return refuse(request, Problem::new(ErrorKind::Overloaded, detail));
    };
    let length = request.headers().get(CONTENT_LENGTH).and_then(|value| value.to_str().ok());
    let limit = gate.settings.server.body_limit_bytes;
    if length.and_then(|length| length.parse::<u64>().ok()).is_some_and(|n| n > limit as u64) {
        return refuse(request, Problem::new(ErrorKind::TooLarge, too_large(limit)));
    }
    let wait = match deadline::requested(request.headers()) {
        Ok(wait) => wait,
        Err(problem) => return refuse(request, problem),
    };
    request.extensions_mut().insert(Deadline(wait.map(|wait| arrival + wait)));
    let watch = BodyWatch::default();
    let request = match policy {
        Some(policy) if policy.is_grpc() => {
            request.map(|body| messages(body, policy, &gate, &watch.budget))
        }
        _ => {
            let encoding = match encoding::of(request.headers()) {
                Ok(encoding) => encoding,
                Err(problem) => return encoding::refuse(request, problem),
            };
            let headers = request.headers().clone();
            let request = request.map(|body| drained(body, &headers));
            encoding::expanded(request, encoding)
                .map(|body| watch.over(body, &gate.settings, &gate.bodies_memory))
        }
    };
    let longest = longest(&gate, &request, policy);
    let allowed = wait.map_or(longest, |wait| wait.min(longest));
    let answered = timeout(allowed, next.run(request)).await;
    watch.budget.close();
    if let Some((problem, reason)) = watch.problem() {
        gate.metrics.refused(reason);
        return closing(problem);
    }
    match (answered, wait) {
        (Ok(response), _) => response,
        (Err(_), Some(wait)) if wait <= longest => {
            gate.metrics.refused(Rejection::Deadline);
            deadline::passed(wait).into_response()
        }
        (Err(_), _) => Problem::new(
            ErrorKind::Unavailable,
            format!("the request took longer than {} s; try again", longest.as_secs()),
        )
        .into_response(),
    }
}

/// Bounds a request that may take any time, message by message or piece by piece.
async fn bound_stream(
    gate: &Gate,
    mut request: Request,
    next: Next,
    arrival: Instant,
    policy: RoutePolicy,
) -> Response {
    let (permit, wait) = match (gate.stream_permit(), deadline::requested(request.headers())) {
        (Ok(permit), Ok(wait)) => (permit, wait),
        (Err(problem), _) | (_, Err(problem)) => return refuse(request, problem),
    };
    let budget = BodyBudget::default();
    request.extensions_mut().insert(Deadline(wait.map(|wait| arrival + wait)));
    request.extensions_mut().insert(budget.clone());
    let request = if policy.is_grpc() {
        request.map(|body| messages(body, policy, gate, &budget))
    } else {
        let encoding = match encoding::of(request.headers()) {
            Ok(encoding) => encoding,
            Err(problem) => return encoding::refuse(request, problem),
        };
        let headers = request.headers().clone();
        let request =
            request.map(|body| upload::bounded(body, &headers, gate.settings.server.body_pause));
        encoding::expanded(request, encoding)
    };
    let mut response = next.run(request).await;
    if policy.bulk || ended_at_once(&response) {
        budget.close();
    }
    if !policy.is_grpc() && !response.status().is_success() {
        response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    }
    response.map(|body| {
        Body::new(body.map_frame(move |frame| {
            // Released when the response ends or the client has gone.
            let _permit = &permit;
            frame
        }))
    })
}

/// Bounds the messages of a call of gRPC.
#[cfg(feature = "grpc")]
fn messages(body: Body, policy: RoutePolicy, gate: &Gate, budget: &BodyBudget) -> Body {
    super::messages::bounded(body, policy, gate, budget.clone())
}

#[cfg(not(feature = "grpc"))]
fn messages(body: Body, _: RoutePolicy, _: &Gate, _: &BodyBudget) -> Body {
    body
}

/// Whether a response has its gRPC status in front: an error, not a stream.
#[cfg(feature = "grpc")]
fn ended_at_once(response: &Response) -> bool {
    super::grpc_status::as_http(response).is_some()
}

#[cfg(not(feature = "grpc"))]
fn ended_at_once(_: &Response) -> bool {
    false
}

/// The longest time that a request may take.
fn longest(gate: &Gate, request: &Request, policy: Option<RoutePolicy>) -> Duration {
    let waits = policy.is_some_and(|policy| policy.waits.apply_to(request.uri()));
    gate.settings.server.request_timeout
        + if waits { gate.settings.max_wait } else { Duration::ZERO }
}
