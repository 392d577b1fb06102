//! Errors as RFC 9457 problems. The only place that maps the kind of an error to an HTTP status.

use std::time::Duration;

use axum::Json;
use axum::extract::Request;
use axum::http::header::{ALLOW, CONTENT_TYPE, RETRY_AFTER};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::request_id::RequestId;
use whereabouts_api::ErrorKind;
use whereabouts_service::ServiceError;

/// An error, for programs and people (RFC 9457, `application/problem+json`).
#[derive(Debug, Clone, Serialize, ToSchema)]
pub(crate) struct Problem {
    /// The type of the problem: `about:blank#` and a keyword.
    #[serde(rename = "type")]
    kind: String,
    /// The type as text.
    title: &'static str,
    /// The HTTP status.
    status: u16,
    /// What happened, and what to do next.
    detail: String,
    /// Id of the request, as in the `x-request-id` header and the logs.
    request_id: String,
    /// The kind, for other forms of the same error.
    #[serde(skip)]
    error_kind: ErrorKind,
    /// How long to wait before trying again.
    #[serde(skip)]
    retry_after: Option<Duration>,
}

impl Problem {
    pub fn new(kind: ErrorKind, detail: impl Into<String>) -> Self {
        let (status, title) = status_of(kind);
        Self {
            kind: format!("about:blank#{}", kind.word()),
            title,
            status: status.as_u16(),
            detail: detail.into(),
            request_id: String::new(),
            error_kind: kind,
            retry_after: kind.retry_after(),
        }
    }

    /// 405, naming the methods of the path.
    pub(super) fn method_not_allowed(request: &Request, allowed: &str) -> Response {
        let (method, path) = (request.method(), request.uri().path());
        let detail = format!("{method} is not possible at {path}; GET /docs lists the calls");
        let mut problem = Self::new(ErrorKind::Malformed, detail);
        (problem.kind, problem.title) = ("about:blank#method".into(), "Method not allowed");
        problem.status = StatusCode::METHOD_NOT_ALLOWED.as_u16();
        let mut response = problem.into_response();
        if let Ok(allowed) = HeaderValue::from_str(allowed) {
            response.headers_mut().insert(ALLOW, allowed);
        }
        response
    }
}

#[cfg(feature = "grpc")]
impl Problem {
    /// Its kind.
    pub(super) fn kind(&self) -> ErrorKind {
        self.error_kind
    }

    /// What happened and what to do next.
    pub(super) fn detail(&self) -> &str {
        &self.detail
    }

    /// How long to wait before trying again.
    pub(super) fn retry_after(&self) -> Option<Duration> {
        self.retry_after
    }
}

/// Whether a request is a call of gRPC, by its media type.
pub(super) fn is_grpc(headers: &HeaderMap) -> bool {
    let media_type = headers.get(CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    media_type.starts_with(b"application/grpc")
}

/// The problem of a request that panicked.
pub(super) fn defect() -> Problem {
    Problem::new(ErrorKind::Internal, "the request hit a defect of the server; see its log")
}

fn status_of(kind: ErrorKind) -> (StatusCode, &'static str) {
    match kind {
        ErrorKind::Malformed => (StatusCode::BAD_REQUEST, "Malformed request"),
        ErrorKind::Unauthorized => (StatusCode::UNAUTHORIZED, "Unauthorized"),
        ErrorKind::Forbidden => (StatusCode::FORBIDDEN, "Forbidden"),
        ErrorKind::NotFound => (StatusCode::NOT_FOUND, "Not found"),
        ErrorKind::Conflict => (StatusCode::CONFLICT, "Conflict"),
        ErrorKind::TooLarge => (StatusCode::PAYLOAD_TOO_LARGE, "Body too large"),
        ErrorKind::UnsupportedMedia => {
            (StatusCode::UNSUPPORTED_MEDIA_TYPE, "Unsupported media type")
        }
        ErrorKind::Unprocessable => (StatusCode::UNPROCESSABLE_ENTITY, "Unprocessable content"),
        ErrorKind::Overloaded => (StatusCode::TOO_MANY_REQUESTS, "Overloaded"),
        ErrorKind::Full => (StatusCode::INSUFFICIENT_STORAGE, "Insufficient storage"),
        ErrorKind::TooSlow => (StatusCode::REQUEST_TIMEOUT, "Request timeout"),
        ErrorKind::DeadlinePassed => (StatusCode::GATEWAY_TIMEOUT, "Deadline passed"),
        ErrorKind::Unavailable => (StatusCode::SERVICE_UNAVAILABLE, "Service unavailable"),
        ErrorKind::Internal => (StatusCode::INTERNAL_SERVER_ERROR, "Internal server error"),
    }
}

impl From<ServiceError> for Problem {
    fn from(error: ServiceError) -> Self {
        Self { retry_after: error.retry_after, ..Self::new(error.kind, error.detail) }
    }
}

impl IntoResponse for Problem {
    /// Leaves the body to [`render`], which knows the request's id.
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = status.into_response();
        response.extensions_mut().insert(self);
        response
    }
}

/// Writes the body of every error response, or its gRPC status.
pub(super) async fn render(request: Request, next: Next) -> Response {
    let is_grpc = is_grpc(request.headers());
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let mut response = next.run(request).await;
    let Some(mut problem) = response.extensions_mut().remove::<Problem>() else { return response };
    if problem.error_kind == ErrorKind::Internal {
        tracing::error!(request_id = %id.0, status = problem.status, detail = problem.detail);
    }
    problem.request_id = id.0;
    let retry_after = problem.retry_after;
    let mut rendered = match is_grpc {
        true => as_grpc(problem),
        false => as_json(problem),
    };
    let headers = rendered.headers_mut();
    if let Some(pause) = retry_after {
        let seconds = pause.as_millis().div_ceil(1000) as u64;
        headers.insert(RETRY_AFTER, HeaderValue::from(seconds));
    }
    // Headers set by inner layers: Connection: close, rate limits.
    headers.extend(std::mem::take(response.headers_mut()));
    rendered
}

fn as_json(problem: Problem) -> Response {
    let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    let mut response = (status, Json(problem)).into_response();
    let media_type = HeaderValue::from_static("application/problem+json");
    response.headers_mut().insert(CONTENT_TYPE, media_type);
    response
}

#[cfg(feature = "grpc")]
fn as_grpc(problem: Problem) -> Response {
    tonic::Status::from(problem).into_http()
}

/// Adds a gRPC status to the problem, so that a client of gRPC shows the reason.
#[cfg(not(feature = "grpc"))]
fn as_grpc(mut problem: Problem) -> Response {
    const UNIMPLEMENTED: HeaderValue = HeaderValue::from_static("12");
    const REASON: &str = "this server was built without gRPC (cargo feature `grpc`)";
    problem.detail = format!("{REASON}; GET /docs lists the calls of HTTP");
    let mut response = as_json(problem);
    response.headers_mut().insert("grpc-status", UNIMPLEMENTED);
    response.headers_mut().insert("grpc-message", HeaderValue::from_static(REASON));
    response
}

/// Answers a request whose path has no route.
pub(super) async fn no_such_path(request: Request) -> Response {
    let path = request.uri().path();
    #[cfg(feature = "grpc")]
    if is_grpc(request.headers()) {
        let detail = format!("there is no call {path}; the reflection service lists the calls");
        return tonic::Status::unimplemented(detail).into_http();
    }
    let detail = format!("there is nothing at {path}; GET /docs lists the calls");
    Problem::new(ErrorKind::NotFound, detail).into_response()
}

pub(super) fn panicked(_: Box<dyn std::any::Any + Send>) -> Response {
    defect().into_response()
}
