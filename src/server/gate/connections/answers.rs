//! The responses in progress on a connection: whether there are any, and whether the client reads them.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use axum::body::{Body, HttpBody};
use bytes::Bytes;
use hyper::body::{Frame, SizeHint};
use parking_lot::Mutex;

use super::slots::Slot;

/// Chunk size for response bodies, in bytes. Larger chunks would hide a client that reads slowly.
const CHUNK: usize = 16 << 10;

/// The responses of one connection. Clones share them.
#[derive(Debug, Clone)]
pub(super) struct Answers {
    slot: Arc<Slot>,
    waiting: Arc<Mutex<Waiting>>,
    /// Whether bytes wait for the client to read.
    unwritten: Arc<AtomicBool>,
}

/// For each response that waits for its client, the time since when.
#[derive(Debug, Default)]
struct Waiting {
    last_id: u64,
    since: BTreeMap<u64, Instant>,
}

/// A request that is in progress until this is dropped.
#[derive(Debug)]
pub(super) struct InProgress {
    answers: Answers,
    id: u64,
}

impl Answers {
    pub fn new(slot: Arc<Slot>) -> Self {
        Self { slot, waiting: Arc::default(), unwritten: Arc::default() }
    }

    /// A flag to set while a write to the client is pending.
    pub fn unwritten(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.unwritten)
    }

    /// Whether no request is in progress and the client has taken all responses.
    pub fn are_over(&self) -> bool {
        self.slot.is_idle() && !self.unwritten.load(Ordering::Relaxed)
    }

    /// Registers a request.
    pub fn begin(&self) -> InProgress {
        self.slot.request_began();
        let mut waiting = self.waiting.lock();
        waiting.last_id += 1;
        InProgress { answers: self.clone(), id: waiting.last_id }
    }

    /// Whether the client has read nothing of some response for longer than `timeout`.
    pub fn are_stalled(&self, timeout: Duration) -> bool {
        self.waiting.lock().since.values().any(|since| since.elapsed() > timeout)
    }
}

impl InProgress {
    /// Wraps the body of the response, so that the request is in progress until the body has ended.
    pub fn over(self, body: Body) -> Body {
        self.wait_for_client();
        Body::new(Watched { body, rest: Bytes::new(), started: false, request: self })
    }

    fn wait_for_client(&self) {
        self.answers.waiting.lock().since.insert(self.id, Instant::now());
    }

    fn client_reads(&self) {
        self.answers.waiting.lock().since.remove(&self.id);
    }
}

impl Drop for InProgress {
    fn drop(&mut self) {
        self.client_reads();
        self.answers.slot.request_ended();
    }
}

/// A body that notes when the client reads from it.
#[derive(Debug)]
struct Watched {
    body: Body,
    /// What is left of the last frame.
    rest: Bytes,
    /// Whether the client was given anything: then the end of the body is polled for only once the client has
    /// room for more.
    started: bool,
    request: InProgress,
}

impl HttpBody for Watched {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        self.request.client_reads();
        if self.rest.is_empty() {
            match ready!(Pin::new(&mut self.body).poll_frame(context)) {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(data) => self.rest = data,
                    Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
                },
                end => return Poll::Ready(end),
            }
        }
        let length = CHUNK.min(self.rest.len());
        let chunk = self.rest.split_to(length);
        self.started = true;
        self.request.wait_for_client();
        Poll::Ready(Some(Ok(Frame::data(chunk))))
    }

    fn is_end_stream(&self) -> bool {
        !self.started && self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let (rest, body) = (self.rest.len() as u64, self.body.size_hint());
        let mut hint = SizeHint::new();
        hint.set_lower(rest + body.lower());
        if let Some(upper) = body.upper() {
            hint.set_upper(rest + upper);
        }
        hint
    }
}

#[cfg(test)]
mod tests {
    use super::super::slots::Slots;
    use super::*;
    use futures_util::StreamExt;

    #[tokio::test]
    async fn a_response_stalls_when_its_client_reads_nothing_but_not_when_the_server_is_slow() {
        let slots = Slots::new(1);
        let answers = Answers::new(Arc::new(slots.take().unwrap()));
        let timeout = Duration::from_millis(30);
        let chunks =
            futures_util::stream::iter([Ok::<_, axum::Error>(Bytes::from(vec![7; CHUNK + 1]))])
                .chain(futures_util::stream::pending());
        let mut body = answers.begin().over(Body::from_stream(chunks)).into_data_stream();
        tokio::time::sleep(2 * timeout).await;
        assert!(answers.are_stalled(timeout), "the first chunk waits");
        for length in [CHUNK, 1] {
            assert_eq!(body.next().await.unwrap().unwrap().len(), length);
            assert!(!answers.are_stalled(timeout));
        }
        assert!(tokio::time::timeout(2 * timeout, body.next()).await.is_err());
        assert!(!answers.are_stalled(timeout), "the server has nothing to give");
        assert!(slots.take().is_none(), "a request is in progress");
        drop(body);
        assert!(slots.take().is_some());
    }
}
