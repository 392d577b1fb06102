//! Bodies of bulk uploads: they may take any time, but no long pause.

use std::time::Duration;

use axum::body::Body;
use axum::http::HeaderMap;
use bytes::Bytes;
use futures_util::stream;

use super::body::DrainedBody;

/// Bounds the pauses of a body, and discards what the handler leaves unread.
pub(super) fn bounded(body: Body, headers: &HeaderMap, pause: Duration) -> Body {
    let upload = Upload { body: DrainedBody::new(body, headers), pause };
    Body::from_stream(stream::unfold(upload, |mut upload| async move {
        let next = upload.next().await?;
        Some((next, upload))
    }))
}

struct Upload {
    body: DrainedBody,
    pause: Duration,
}

impl Upload {
    async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        let next = tokio::time::timeout(self.pause, self.body.next()).await;
        next.unwrap_or_else(|_| {
            self.body.give_up();
            Some(Err(axum::Error::new(BodyPaused(self.pause))))
        })
    }
}

/// The error of an upload that paused for longer than allowed.
#[derive(Debug, thiserror::Error)]
#[error(
    "no data of the body arrived for {} s (server.body_pause_s); send it again, what was stored stays stored",
    .0.as_secs()
)]
pub(crate) struct BodyPaused(Duration);
