//! `X-Deadline-Ms`: how long a client is willing to wait for an answer.

use std::convert::Infallible;
use std::time::{Duration, Instant};

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName};

use super::problem::Problem;
use crate::service::ErrorKind;

/// Milliseconds from the arrival of the request's head.
pub(super) const DEADLINE: HeaderName = HeaderName::from_static("x-deadline-ms");

/// The longest wait that can be asked for: longer than any request may take.
const LONGEST_MS: u64 = 3_600_000;

/// When the client no longer wants the answer, if it said so.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Deadline(pub Option<Instant>);

/// The wait that the headers allow.
pub(super) fn allowed(headers: &HeaderMap) -> Result<Option<Duration>, Problem> {
    let Some(value) = headers.get(DEADLINE) else { return Ok(None) };
    let milliseconds = value.to_str().ok().and_then(|text| text.parse::<u64>().ok());
    match milliseconds {
        Some(wait @ 1..=LONGEST_MS) => Ok(Some(Duration::from_millis(wait))),
        _ => Err(Problem::new(
            ErrorKind::Malformed,
            format!(
                "X-Deadline-Ms is {value:?}; it must be a whole number of milliseconds from 1 to \
                 {LONGEST_MS}"
            ),
        )),
    }
}

pub(super) fn passed(wait: Duration) -> Problem {
    Problem::new(
        ErrorKind::DeadlinePassed,
        format!(
            "the {} ms of X-Deadline-Ms have passed, and the request was given up; allow more time, \
             or send a later frame",
            wait.as_millis()
        ),
    )
}

impl<S: Sync> FromRequestParts<S> for Deadline {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(parts.extensions.get().copied().unwrap_or_default())
    }
}
