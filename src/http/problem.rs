//! Errors as RFC 9457 problems. This is the one place that maps an error's kind to a status.

use axum::Json;
use axum::extract::Request;
use axum::http::header::{CONTENT_TYPE, RETRY_AFTER};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::guard::RequestId;
use crate::service::{ErrorKind, ServiceError};

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
    /// When it is worth trying again, in whole seconds.
    #[serde(skip)]
    retry_after: Option<u64>,
}

impl Problem {
    pub fn new(kind: ErrorKind, detail: impl Into<String>) -> Self {
        let (status, word, title) = status_of(kind);
        Self {
            kind: format!("about:blank#{word}"),
            title,
            status: status.as_u16(),
            detail: detail.into(),
            request_id: String::new(),
            retry_after: match kind {
                ErrorKind::Overloaded => Some(1),
                ErrorKind::Unavailable => Some(2),
                _ => None,
            },
        }
    }
}

/// The request hit a defect of the server.
pub(super) fn defect() -> Problem {
    Problem::new(ErrorKind::Internal, "the request hit a defect of the server; see its log")
}

fn status_of(kind: ErrorKind) -> (StatusCode, &'static str, &'static str) {
    match kind {
        ErrorKind::Malformed => (StatusCode::BAD_REQUEST, "malformed", "Malformed request"),
        ErrorKind::Unauthorized => (StatusCode::UNAUTHORIZED, "unauthorized", "Unauthorized"),
        ErrorKind::Forbidden => (StatusCode::FORBIDDEN, "forbidden", "Forbidden"),
        ErrorKind::NotFound => (StatusCode::NOT_FOUND, "not-found", "Not found"),
        ErrorKind::Conflict => (StatusCode::CONFLICT, "conflict", "Conflict"),
        ErrorKind::TooLarge => (StatusCode::PAYLOAD_TOO_LARGE, "too-large", "Body too large"),
        ErrorKind::UnsupportedMedia => {
            (StatusCode::UNSUPPORTED_MEDIA_TYPE, "media-type", "Unsupported media type")
        }
        ErrorKind::Unprocessable => {
            (StatusCode::UNPROCESSABLE_ENTITY, "unprocessable", "Unprocessable content")
        }
        ErrorKind::Overloaded => (StatusCode::TOO_MANY_REQUESTS, "overloaded", "Overloaded"),
        ErrorKind::Full => (StatusCode::INSUFFICIENT_STORAGE, "disk-full", "Insufficient storage"),
        ErrorKind::TooSlow => (StatusCode::REQUEST_TIMEOUT, "too-slow", "Request timeout"),
        ErrorKind::DeadlinePassed => {
            (StatusCode::GATEWAY_TIMEOUT, "deadline-passed", "Deadline passed")
        }
        ErrorKind::Unavailable => {
            (StatusCode::SERVICE_UNAVAILABLE, "unavailable", "Service unavailable")
        }
        ErrorKind::Internal => {
            (StatusCode::INTERNAL_SERVER_ERROR, "internal", "Internal server error")
        }
    }
}

impl From<ServiceError> for Problem {
    fn from(error: ServiceError) -> Self {
        let mut problem = Self::new(error.kind, error.detail);
        if let Some(pause) = error.retry_after {
            problem.retry_after = Some(pause.as_millis().div_ceil(1000) as u64);
        }
        problem
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

/// Writes the body of every error response.
pub(super) async fn render(request: Request, next: Next) -> Response {
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let mut response = next.run(request).await;
    let Some(mut problem) = response.extensions_mut().remove::<Problem>() else { return response };
    if problem.status == StatusCode::INTERNAL_SERVER_ERROR {
        tracing::error!(request_id = %id.0, status = problem.status, detail = problem.detail);
    }
    problem.request_id = id.0;
    let retry_after = problem.retry_after;
    let mut rendered = (response.status(), Json(problem)).into_response();
    let headers = rendered.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
    if let Some(seconds) = retry_after {
        headers.insert(RETRY_AFTER, HeaderValue::from(seconds));
    }
    // What was said beside the body: that the connection closes, what is left to a key.
    headers.extend(std::mem::take(response.headers_mut()));
    rendered
}

pub(super) async fn no_such_path(request: Request) -> Problem {
    Problem::new(
        ErrorKind::NotFound,
        format!("there is nothing at {}; GET /docs lists the calls", request.uri().path()),
    )
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
