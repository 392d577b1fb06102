//! The id of a request, for logs and error messages.

use axum::extract::Request;
use axum::http::HeaderName;

/// The id of a request: the caller's `x-request-id`, or a generated one.
#[derive(Debug, Clone, Default)]
pub(super) struct RequestId(pub String);

/// The header in which a caller may send an id, and gets it back.
pub(super) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// Returns the id that the caller sent if it is usable, else a new one.
pub(super) fn request_id(request: &Request) -> RequestId {
    let usable = |text: &&str| {
        (1..=64).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic())
    };
    let sent = request.headers().get(REQUEST_ID).and_then(|value| value.to_str().ok());
    RequestId(match sent.filter(usable) {
        Some(id) => id.to_owned(),
        None => uuid::Uuid::now_v7().to_string(),
    })
}
