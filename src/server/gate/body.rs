//! Reads a body whole, or discards it so that the client sees the answer.

use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use axum::extract::Request;
use axum::http::HeaderValue;
use axum::http::header::{CONNECTION, EXPECT};
use axum::response::{IntoResponse, Response};
use bytes::{Bytes, BytesMut};
use futures_util::StreamExt;

use super::problem::Problem;
use whereabouts_api::ErrorKind;

/// Says that a body exceeds the bound.
pub(crate) fn too_large(limit: usize) -> String {
    format!("the body exceeds {limit} bytes (server.body_limit_bytes); send a smaller picture")
}

/// Reads a body of at most `limit` bytes. The rest of a larger one is discarded: a client that is still
/// sending would see a reset connection instead of the answer.
pub(crate) async fn read_whole(body: Body, limit: usize) -> Result<Bytes, Problem> {
    let mut chunks = body.into_data_stream();
    let mut whole = BytesMut::new();
    while let Some(chunk) = chunks.next().await {
        let chunk = chunk.map_err(|error| {
            Problem::new(ErrorKind::Malformed, format!("the body cannot be read: {error}"))
        })?;
        if whole.len() + chunk.len() > limit {
            tokio::spawn(discard(chunks));
            return Err(Problem::new(ErrorKind::TooLarge, too_large(limit)));
        }
        whole.extend_from_slice(&chunk);
    }
    Ok(whole.freeze())
}

/// Reads and drops the rest of a body, for at most five seconds.
pub(crate) async fn discard(mut chunks: BodyDataStream) {
    const LONGEST: Duration = Duration::from_secs(5);
    let all = async move { while let Some(Ok(_)) = chunks.next().await {} };
    let _ = tokio::time::timeout(LONGEST, all).await;
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
