//! The answers that a connection is giving: whether there are any, and whether the client takes them.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use axum::body::{Body, HttpBody};
use bytes::Bytes;
use hyper::body::{Frame, SizeHint};
use parking_lot::{Mutex, MutexGuard};

use super::slots::Slot;

/// The largest piece that is handed over at once, in bytes: what comes in one piece could not be seen to
/// be taken slowly.
const PIECE: usize = 16 << 10;

/// The answers of one connection. Clones share them.
#[derive(Debug, Clone)]
pub(super) struct Answers {
    slot: Arc<Slot>,
    handed: Arc<Mutex<Handed>>,
}

/// Since when the client is to take the next piece of each answer that has one.
#[derive(Debug, Default)]
struct Handed {
    next: u64,
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
        Self { slot, handed: Arc::default() }
    }

    /// A request has come.
    pub fn begin(&self) -> InProgress {
        self.slot.request_began();
        let mut handed = self.handed();
        handed.next += 1;
        InProgress { answers: self.clone(), id: handed.next }
    }

    /// Whether the client has taken nothing of some answer for so long.
    pub fn are_stalled(&self, patience: Duration) -> bool {
        self.handed().since.values().any(|since| since.elapsed() > patience)
    }

    fn handed(&self) -> MutexGuard<'_, Handed> {
        self.handed.lock()
    }
}

impl InProgress {
    /// The body of the answer to this request, which is in progress as long as there is more of it.
    pub fn over(self, body: Body) -> Body {
        self.wait_for_client();
        Body::new(Watched { body, rest: Bytes::new(), handed: false, request: self })
    }

    fn wait_for_client(&self) {
        self.answers.handed().since.insert(self.id, Instant::now());
    }

    fn client_asks(&self) {
        self.answers.handed().since.remove(&self.id);
    }
}

impl Drop for InProgress {
    fn drop(&mut self) {
        self.client_asks();
        self.answers.slot.request_ended();
    }
}

/// A body that says when the client takes of it.
#[derive(Debug)]
struct Watched {
    body: Body,
    /// What is left of the last piece.
    rest: Bytes,
    /// Whether anything was handed over: then the end comes by itself, when the client has room for more.
    handed: bool,
    request: InProgress,
}

impl HttpBody for Watched {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        self.request.client_asks();
        if self.rest.is_empty() {
            match ready!(Pin::new(&mut self.body).poll_frame(context)) {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(data) => self.rest = data,
                    Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
                },
                end => return Poll::Ready(end),
            }
        }
        let piece = PIECE.min(self.rest.len());
        let piece = self.rest.split_to(piece);
        self.handed = true;
        self.request.wait_for_client();
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        !self.handed && self.rest.is_empty() && self.body.is_end_stream()
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
    async fn an_answer_that_nobody_takes_is_seen_and_one_that_waits_for_the_server_is_not() {
        let slots = Slots::new(1);
        let answers = Answers::new(Arc::new(slots.take().unwrap()));
        let patience = Duration::from_millis(30);
        let pieces =
            futures_util::stream::iter([Ok::<_, axum::Error>(Bytes::from(vec![7; PIECE + 1]))])
                .chain(futures_util::stream::pending());
        let mut body = answers.begin().over(Body::from_stream(pieces)).into_data_stream();
        tokio::time::sleep(2 * patience).await;
        assert!(answers.are_stalled(patience), "the first piece waits");
        for length in [PIECE, 1] {
            assert_eq!(body.next().await.unwrap().unwrap().len(), length);
            assert!(!answers.are_stalled(patience));
        }
        assert!(tokio::time::timeout(2 * patience, body.next()).await.is_err());
        assert!(!answers.are_stalled(patience), "the server has nothing to give");
        assert!(slots.take().is_none(), "a request is in progress");
        drop(body);
        assert!(slots.take().is_some());
    }
}
