//! Bodies of bulk uploads: they may take any time, but no long pause.

use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::runtime::Handle;

use super::body::discard;

/// Bounds the pauses of a body. What the handler leaves unread is discarded for a while: a client that is
/// still sending would see a reset connection instead of the answer.
pub(super) fn bounded(body: Body, pause: Duration) -> Body {
    let upload = Upload { body: Some(body.into_data_stream()), pause };
    Body::from_stream(stream::unfold(upload, |mut upload| async move {
        let next = upload.next().await?;
        Some((next, upload))
    }))
}

struct Upload {
    /// `None` once it has ended or failed.
    body: Option<BodyDataStream>,
    pause: Duration,
}

impl Upload {
    async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        let next = tokio::time::timeout(self.pause, self.body.as_mut()?.next()).await;
        let next = next.unwrap_or_else(|_| Some(Err(axum::Error::new(BodyPaused(self.pause)))));
        if !matches!(next, Some(Ok(_))) {
            self.body = None;
        }
        next
    }
}

impl Drop for Upload {
    fn drop(&mut self) {
        if let (Some(body), Ok(runtime)) = (self.body.take(), Handle::try_current()) {
            runtime.spawn(discard(body));
        }
    }
}

/// The error of an upload that paused for longer than allowed.
#[derive(Debug, thiserror::Error)]
#[error(
    "no data of the body arrived for {} s (server.body_pause_s); send it again, what was stored stays stored",
    .0.as_secs()
)]
pub(crate) struct BodyPaused(Duration);
