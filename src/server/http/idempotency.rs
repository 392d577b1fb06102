//! `Idempotency-Key`: a POST that is sent again because its answer was lost is not done again.
//!
//! After the IETF draft *The Idempotency-Key HTTP Header Field* (draft-ietf-httpapi-idempotency-key-header).

use std::sync::Arc;

use axum::body::{Body, to_bytes};
use axum::extract::{MatchedPath, Request, State};
use axum::http::header::{CONTENT_TYPE, RETRY_AFTER};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tracing::Instrument;

use super::batch;
use super::body::whole;
use super::problem::{Problem, defect};
use super::state::AppState;
use crate::grpc;
use whereabouts_api::ErrorKind;
use whereabouts_core::Digest;
use whereabouts_service::{Once, Principal, Service};
use whereabouts_store::StoredResponse;

pub(super) const IDEMPOTENCY_KEY: &str = "idempotency-key";
const REPLAYED: HeaderName = HeaderName::from_static("idempotent-replayed");

/// The longest key, in bytes.
pub(super) const LONGEST_KEY: usize = 255;

/// The largest answer that is kept, in bytes; none comes near it.
const LARGEST_ANSWER: usize = 4 << 20;

/// The id of a request that has a key, for those who note what they have done for it.
#[derive(Debug, Clone)]
pub(super) struct IdempotencyId(pub String);

/// Whether a call can be sent again with a key. The answers of those that make an API key and a webhook are
/// not kept, because a secret is in them; a call of gRPC is no single text; many images can be sent again
/// anyway, and may be too many to look at before.
pub(super) fn applies(method: &Method, route: &str) -> bool {
    let never = ["/keys", "/webhooks", batch::PATH];
    method == Method::POST && !never.contains(&route) && grpc::call(route).is_none()
}

/// Does a request with a key once, and gives its answer again.
pub(super) async fn once(State(state): State<AppState>, request: Request, next: Next) -> Response {
    if request.method() != Method::POST || !request.headers().contains_key(IDEMPOTENCY_KEY) {
        return next.run(request).await;
    }
    answer(state, request, next).await.unwrap_or_else(IntoResponse::into_response)
}

async fn answer(state: AppState, request: Request, next: Next) -> Result<Response, Problem> {
    let key = key(request.headers())?;
    let route = request.extensions().get::<MatchedPath>().map_or("", MatchedPath::as_str);
    if !applies(request.method(), route) {
        return Err(Problem::new(
            ErrorKind::Malformed,
            "this call takes no Idempotency-Key: what it answers is not kept; leave the header out",
        ));
    }
    let service = state.door.service()?;
    let scope = request.extensions().get::<Principal>().map_or("-", Principal::scope);
    let id = format!("{scope} {key}");
    let (parts, body) = request.into_parts();
    let bytes = whole(Request::new(body), &state).await?;
    let what = format!("{} {}\n", parts.method, parts.uri);
    let kind = parts.headers.get(CONTENT_TYPE).map_or(&[][..], HeaderValue::as_bytes);
    let fingerprint = Digest::of(&[what.as_bytes(), kind, b"\n", &bytes].concat());
    match service.idempotency.begin(&id, fingerprint).await? {
        Once::Again(kept) => Ok(replay(kept)),
        Once::Other => Err(Problem::new(
            ErrorKind::Unprocessable,
            "this Idempotency-Key was sent with another request before; each request has a key of its own",
        )),
        Once::Running => {
            let detail =
                "a request with this Idempotency-Key is in progress; ask again in a second";
            let mut response = Problem::new(ErrorKind::Conflict, detail).into_response();
            response.headers_mut().insert(RETRY_AFTER, HeaderValue::from_static("1"));
            Ok(response)
        }
        Once::First => {
            let mut request = Request::from_parts(parts, Body::from(bytes));
            request.extensions_mut().insert(IdempotencyId(id.clone()));
            // Goes on when the sender has gone: it will ask again.
            let doing = do_and_keep(service, id, fingerprint, request, next);
            let doing = tokio::spawn(doing.in_current_span());
            doing.await.map_err(|_| defect())
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

/// Answers, and keeps the answer if it is a success. An error is not kept: the same request meets it again,
/// or has better luck.
async fn do_and_keep(
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
            let detail = format!("the answer broke off: {error}");
            return Problem::new(ErrorKind::Internal, detail).into_response();
        }
    };
    let kept = std::str::from_utf8(&text).ok().filter(|_| parts.status.is_success());
    let kept = kept.map(|body| StoredResponse {
        status: parts.status.as_u16(),
        content_type: parts
            .headers
            .get(CONTENT_TYPE)
            .and_then(|kind| Some(kind.to_str().ok()?.to_owned())),
        body: body.to_owned(),
    });
    if let Err(error) = service.idempotency.end(&id, fingerprint, kept).await {
        // It is done all the same.
        tracing::error!(%error, "an answer could not be kept for an Idempotency-Key");
    }
    Response::from_parts(parts, Body::from(text))
}

fn replay(kept: StoredResponse) -> Response {
    let StoredResponse { status, content_type, body } = kept;
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
