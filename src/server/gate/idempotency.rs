//! `Idempotency-Key`: a POST that is sent again because its answer was lost is not done again.
//!
//! Follows the IETF draft *The Idempotency-Key HTTP Header Field* (draft-ietf-httpapi-idempotency-key-header).

use std::sync::Arc;

use axum::body::{Body, to_bytes};
use axum::extract::{Request, State};
use axum::http::header::{CONTENT_TYPE, RETRY_AFTER};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use sha2::{Digest as _, Sha256};
use tracing::Instrument;

use super::body::read_whole;
use super::policy::{RouteMatch, policy};
use super::problem::{Problem, defect};
use super::state::Gate;
use whereabouts_api::ErrorKind;
use whereabouts_core::Digest;
use whereabouts_service::{IdempotencyOutcome, Principal, Service};
use whereabouts_store::StoredResponse;

const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");
const REPLAYED: HeaderName = HeaderName::from_static("idempotent-replayed");

/// Longest key, in bytes.
pub(crate) const LONGEST_KEY: usize = 255;

/// Largest answer that is stored, in bytes; no answer comes near it.
const LARGEST_ANSWER: usize = 4 << 20;

/// Largest body that is hashed on the async thread, in bytes: some 50 µs of work.
const HASHED_INLINE: usize = 64 << 10;

/// Identifies a request with a key: the caller's scope and the key. Handlers store it with what they create.
#[derive(Debug, Clone)]
pub(crate) struct IdempotencyId(pub String);

/// Runs a request with a key once, and replays its answer when it is sent again.
pub(super) async fn replay_or_run(
    State(gate): State<Gate>,
    request: Request,
    next: Next,
) -> Response {
    let applies = request.method() == Method::POST
        && request.headers().contains_key(IDEMPOTENCY_KEY)
        && request.extensions().get::<RouteMatch>().is_some();
    if !applies {
        return next.run(request).await;
    }
    answer(gate, request, next).await.unwrap_or_else(IntoResponse::into_response)
}

async fn answer(gate: Gate, request: Request, next: Next) -> Result<Response, Problem> {
    let key = key(request.headers())?;
    if !policy(&request).is_some_and(|policy| policy.idempotent) {
        return Err(Problem::new(
            ErrorKind::Malformed,
            "this call takes no Idempotency-Key, because its answer is not stored; leave the header out",
        ));
    }
    let service = gate.readiness.service()?;
    let scope = request.extensions().get::<Principal>().map_or("-", Principal::scope);
    let id = format!("{scope} {key}");
    let (parts, body) = request.into_parts();
    let body = read_whole(body, gate.settings.server.body_limit_bytes).await?;
    let fingerprint = fingerprint(&parts, &body).await?;
    match service.idempotency.begin(&id, fingerprint).await? {
        IdempotencyOutcome::Replay(stored) => Ok(replay(stored)),
        IdempotencyOutcome::KeyReused => Err(Problem::new(
            ErrorKind::Unprocessable,
            "this Idempotency-Key was used for another request; use a new key for each request",
        )),
        IdempotencyOutcome::InProgress => {
            let detail =
                "a request with this Idempotency-Key is in progress; try again in a second";
            let mut response = Problem::new(ErrorKind::Conflict, detail).into_response();
            response.headers_mut().insert(RETRY_AFTER, HeaderValue::from_static("1"));
            Ok(response)
        }
        IdempotencyOutcome::First => {
            let mut request = Request::from_parts(parts, Body::from(body));
            request.extensions_mut().insert(IdempotencyId(id.clone()));
            // Continues when the client disconnects, because it will ask again.
            let running = run_and_store(service, id, fingerprint, request, next);
            let running = tokio::spawn(running.in_current_span());
            running.await.map_err(|_| defect())
        }
    }
}

fn key(headers: &HeaderMap) -> Result<String, Problem> {
    let mut sent = headers.get_all(IDEMPOTENCY_KEY).iter();
    let first = sent.next().map(HeaderValue::as_bytes).unwrap_or_default();
    let visible = first.iter().all(u8::is_ascii_graphic);
    match std::str::from_utf8(first) {
        Ok(key) if (1..=LONGEST_KEY).contains(&key.len()) && visible && sent.next().is_none() => {
            Ok(key.to_owned())
        }
        _ => Err(Problem::new(
            ErrorKind::Malformed,
            format!("one Idempotency-Key must be 1 to {LONGEST_KEY} visible ASCII characters"),
        )),
    }
}

/// Tells one request from another: SHA-256 of method, URI, media type and body. A large body is hashed on a
/// blocking thread.
async fn fingerprint(parts: &Parts, body: &Bytes) -> Result<Digest, Problem> {
    let mut hasher = Sha256::new();
    hasher.update(format!("{} {}\n", parts.method, parts.uri));
    hasher.update(parts.headers.get(CONTENT_TYPE).map_or(&[][..], HeaderValue::as_bytes));
    hasher.update(b"\n");
    let (body, small) = (body.clone(), body.len() <= HASHED_INLINE);
    let finish = move || {
        hasher.update(&body);
        Digest::from(<[u8; 32]>::from(hasher.finalize()))
    };
    match small {
        true => Ok(finish()),
        false => tokio::task::spawn_blocking(finish).await.map_err(|_| defect()),
    }
}

/// Runs the request, and stores its answer if it is a success. An error is not stored: the request may
/// succeed when it is sent again.
async fn run_and_store(
    service: Arc<Service>,
    id: String,
    fingerprint: Digest,
    request: Request,
    next: Next,
) -> Response {
    let response = next.run(request).await;
    let (parts, body) = response.into_parts();
    let text = match to_bytes(body, LARGEST_ANSWER).await {
        Ok(bytes) => bytes,
        Err(error) => {
            let detail = format!("the answer was cut short: {error}");
            return Problem::new(ErrorKind::Internal, detail).into_response();
        }
    };
    let stored = std::str::from_utf8(&text).ok().filter(|_| parts.status.is_success());
    let stored = stored.map(|body| StoredResponse {
        status: parts.status.as_u16(),
        content_type: parts
            .headers
            .get(CONTENT_TYPE)
            .and_then(|kind| Some(kind.to_str().ok()?.to_owned())),
        body: body.to_owned(),
    });
    if let Err(error) = service.idempotency.end(&id, fingerprint, stored).await {
        // The request itself has succeeded.
        tracing::error!(%error, "an answer could not be stored for an Idempotency-Key");
    }
    Response::from_parts(parts, Body::from(text))
}

fn replay(stored: StoredResponse) -> Response {
    let StoredResponse { status, content_type, body } = stored;
    let status = StatusCode::from_u16(status).unwrap_or(StatusCode::OK);
    let mut response = (status, body).into_response();
    let headers = response.headers_mut();
    headers.remove(CONTENT_TYPE);
    if let Some(kind) = content_type.and_then(|kind| HeaderValue::from_str(&kind).ok()) {
        headers.insert(CONTENT_TYPE, kind);
    }
    headers.insert(REPLAYED, HeaderValue::from_static("true"));
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_fingerprint_covers_method_uri_media_type_and_body_of_any_size() {
        let request =
            axum::http::Request::post("/localize?map=yard").header(CONTENT_TYPE, "image/jpeg");
        let (parts, ()) = request.body(()).unwrap().into_parts();
        for size in [0, 5, HASHED_INLINE, HASHED_INLINE + 1] {
            let body = Bytes::from(vec![7; size]);
            let joined = [&b"POST /localize?map=yard\nimage/jpeg\n"[..], &body].concat();
            assert_eq!(fingerprint(&parts, &body).await.unwrap(), Digest::of(&joined), "{size}");
        }
    }
}
