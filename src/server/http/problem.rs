//! Errors as RFC 9457 problems. This is the one place that maps an error's kind to a status.

use std::time::Duration;

use axum::Json;
use axum::extract::Request;
use axum::http::header::{CONTENT_TYPE, RETRY_AFTER};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::guard::RequestId;
use crate::grpc;
use whereabouts_api::ErrorKind;
use whereabouts_service::ServiceError;

/// What went wrong, for programs and people (RFC 9457, `application/problem+json`).
#[derive(Debug, Clone, Serialize, ToSchema)]
pub(super) struct Problem {
    /// Which kind of problem: `about:blank#` and a word.
    #[serde(rename = "type")]
    kind: String,
    /// The kind in words.
    title: &'static str,
    /// The HTTP status.
    status: u16,
    /// What happened and what to do next.
    detail: String,
    /// The id of the request, as in the `x-request-id` header and the logs.
    request_id: String,
    /// The kind, for other forms than this.
    #[serde(skip)]
    of: ErrorKind,
    /// When it is worth trying again.
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
            of: kind,
            retry_after: kind.retry_after(),
        }
    }
}

impl Problem {
    /// Its kind.
    pub fn kind(&self) -> ErrorKind {
        self.of
    }
}

/// The request hit a defect of the server.
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

impl From<Problem> for tonic::Status {
    fn from(problem: Problem) -> Self {
        grpc::status::status(problem.of, &problem.detail, problem.retry_after)
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

/// Writes the body of every error response, or the status of a call of gRPC.
pub(super) async fn render(request: Request, next: Next) -> Response {
    let is_call = grpc::is_call(request.headers());
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let mut response = next.run(request).await;
    let Some(mut problem) = response.extensions_mut().remove::<Problem>() else { return response };
    if problem.status == StatusCode::INTERNAL_SERVER_ERROR {
        tracing::error!(request_id = %id.0, status = problem.status, detail = problem.detail);
    }
    problem.request_id = id.0;
    let retry_after = problem.retry_after;
    let mut rendered = if is_call {
        tonic::Status::from(problem).into_http()
    } else {
        let mut rendered = (response.status(), Json(problem)).into_response();
        let problem = HeaderValue::from_static("application/problem+json");
        rendered.headers_mut().insert(CONTENT_TYPE, problem);
        rendered
    };
    let headers = rendered.headers_mut();
    if let Some(pause) = retry_after {
        let seconds = pause.as_millis().div_ceil(1000) as u64;
        headers.insert(RETRY_AFTER, HeaderValue::from(seconds));
    }
    // What was said beside the body: that the connection closes, what is left to a key.
    headers.extend(std::mem::take(response.headers_mut()));
    rendered
}

pub(super) async fn no_such_path(request: Request) -> Response {
    let path = request.uri().path();
    if grpc::is_call(request.headers()) {
        let detail =
            format!("there is no call {path}; ask the reflection service for those there are");
        return tonic::Status::unimplemented(detail).into_http();
    }
    let detail = format!("there is nothing at {path}; GET /docs lists the calls");
    Problem::new(ErrorKind::NotFound, detail).into_response()
}

pub(super) async fn no_such_method(request: Request) -> Response {
    let mut problem = Problem::new(
        ErrorKind::Malformed,
        format!(
            "{} is not possible at {}; GET /docs lists the calls",
            request.method(),
            request.uri().path()
        ),
    );
    (problem.kind, problem.title) = ("about:blank#method".into(), "Method not allowed");
    problem.status = StatusCode::METHOD_NOT_ALLOWED.as_u16();
    problem.into_response()
}

pub(super) fn panicked(_: Box<dyn std::any::Any + Send>) -> Response {
    defect().into_response()
}
