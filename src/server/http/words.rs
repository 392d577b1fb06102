//! Descriptions in the place of frames.

use axum::body::Body;
use axum::extract::Request;

use super::body::{content_type, object};
use super::state::AppState;
use crate::gate::{Problem, read_whole};
use whereabouts_api::{ErrorKind, WordsRequest};

/// Types of a body that may be a description: `curl -d` calls it a form.
const TYPES: [&str; 2] = ["application/json", "application/x-www-form-urlencoded"];

/// Returns the description that a request has instead of a frame, if any, and otherwise the request as it came.
pub(super) async fn of(
    text: Option<String>,
    request: Request,
    state: &AppState,
) -> Result<(Option<String>, Request), Problem> {
    let may_be_words = TYPES.contains(&content_type(request.headers()).1.as_str());
    if text.is_none() && !may_be_words {
        return Ok((None, request));
    }
    let (parts, body) = request.into_parts();
    let body = read_whole(body, state.gate.settings.server.body_limit_bytes).await?;
    if text.is_some() {
        if !body.is_empty() {
            let detail = "there are a text and a body; send either a description or a frame";
            return Err(Problem::new(ErrorKind::Unprocessable, detail));
        }
        return Ok((text, Request::from_parts(parts, Body::empty())));
    }
    // No picture begins with a brace, whatever its type is called. A byte order mark may be before it.
    let start = body.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&body).trim_ascii_start();
    if !start.starts_with(b"{") {
        return Ok((None, Request::from_parts(parts, Body::from(body))));
    }
    let WordsRequest { text } = object(&body).map_err(|error| {
        let detail = format!(
            "the body is not a description: {error}; send {{\"text\": \"opposite the pharmacy\"}}, or the bytes of a \
             picture (with curl: -H 'Content-Type: image/jpeg' --data-binary @frame.jpg)"
        );
        Problem::new(ErrorKind::Malformed, detail)
    })?;
    Ok((Some(text), Request::from_parts(parts, Body::empty())))
}
