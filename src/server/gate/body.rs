//! Reads a body whole, or discards it: a client that is still sending would see a reset connection instead of the
//! answer.

use std::time::Duration;

use axum::body::{Body, BodyDataStream, HttpBody};
use axum::extract::Request;
use axum::http::header::{CONNECTION, EXPECT};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::{IntoResponse, Response};
use bytes::{Bytes, BytesMut};
use futures_util::{StreamExt, stream};
use tokio::runtime::Handle;
use tokio::time::timeout;

use super::problem::Problem;
use whereabouts_api::ErrorKind;

/// Says that a body exceeds the bound.
pub(crate) fn too_large(limit: usize) -> String {
    format!("the body exceeds {limit} bytes (server.body_limit_bytes); send a smaller picture")
}

/// Reads a body of at most `limit` bytes.
pub(crate) async fn read_whole(body: Body, limit: usize) -> Result<Bytes, Problem> {
    let mut chunks = body.into_data_stream();
    let mut whole = BytesMut::new();
    while let Some(chunk) = chunks.next().await {
        let chunk = chunk.map_err(|error| {
            Problem::new(ErrorKind::Malformed, format!("the body cannot be read: {error}"))
        })?;
        if whole.len() + chunk.len() > limit {
            return Err(Problem::new(ErrorKind::TooLarge, too_large(limit)));
        }
        whole.extend_from_slice(&chunk);
    }
    Ok(whole.freeze())
}

/// Reads and drops the rest of a body: at most 256 MiB in five seconds, and until the client pauses for one.
pub(super) async fn discard(mut chunks: BodyDataStream) {
    const LONGEST: Duration = Duration::from_secs(5);
    const LONGEST_PAUSE: Duration = Duration::from_secs(1);
    const MOST: usize = 256 << 20;
    let all = async move {
        let mut bytes = 0;
        while bytes < MOST
            && let Ok(Some(Ok(chunk))) = timeout(LONGEST_PAUSE, chunks.next()).await
        {
            bytes += chunk.len();
        }
    };
    let _ = timeout(LONGEST, all).await;
}

/// A body of which nothing is left unread: what its reader leaves is discarded when it is dropped.
pub(super) struct DrainedBody {
    /// `None` once it has ended or is not to be discarded.
    chunks: Option<BodyDataStream>,
    /// Whether the client sends the body without being asked for it, by the first read.
    unasked: bool,
}

impl DrainedBody {
    /// `headers` are those of the request.
    pub fn new(body: Body, headers: &HeaderMap) -> Self {
        let unasked = !headers.contains_key(EXPECT);
        Self { chunks: Some(body.into_data_stream()), unasked }
    }

    /// The next chunk; `None` after the last, and after an error.
    pub async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        self.unasked = true;
        let next = self.chunks.as_mut()?.next().await;
        if !matches!(next, Some(Ok(_))) {
            self.chunks = None;
        }
        next
    }

    /// Leaves the rest unread: the client is too slow to be waited for.
    pub fn give_up(&mut self) {
        self.chunks = None;
    }
}

/// A body whose reader may leave some of it unread: the rest is discarded.
pub(super) fn drained(body: Body, headers: &HeaderMap) -> Body {
    if body.is_end_stream() {
        return body;
    }
    Body::from_stream(stream::unfold(DrainedBody::new(body, headers), |mut body| async {
        let next = body.next().await?;
        Some((next, body))
    }))
}

impl Drop for DrainedBody {
    fn drop(&mut self) {
        if let (Some(chunks), true, Ok(runtime)) =
            (self.chunks.take(), self.unasked, Handle::try_current())
        {
            runtime.spawn(discard(chunks));
        }
    }
}

/// Discards the body of a request that is refused. A client that sent `Expect: 100-continue` has not sent
/// its body, and is not asked for it.
pub(crate) fn throw_away(request: Request) {
    if !request.headers().contains_key(EXPECT) {
        tokio::spawn(discard(request.into_body().into_data_stream()));
    }
}

/// Answers a request without reading its body, and closes the connection.
pub(super) fn refuse(request: Request, problem: Problem) -> Response {
    throw_away(request);
    closing(problem)
}

/// An answer after which the connection is closed.
pub(super) fn closing(problem: Problem) -> Response {
    let mut response = problem.into_response();
    response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    response
}
