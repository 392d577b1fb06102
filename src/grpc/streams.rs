//! Streams of answers, and what ends them.

use std::pin::Pin;

use futures_util::{Stream, StreamExt, future, stream};
use tonic::Status;

use super::{Asked, status};
use crate::service::{Door, ErrorKind};

/// Answers, one after another.
pub(super) type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Answers until they end, the server drains, the caller may ask no more, or wants no more.
pub(super) fn until_over<T: Send + 'static>(
    answers: impl Stream<Item = Result<T, Status>> + Send + 'static,
    door: &Door,
    asked: Asked,
) -> Answers<T> {
    let draining = door.draining();
    let Asked { service, caller, deadline } = asked;
    let over = async move {
        let deadline = async {
            match deadline.0 {
                Some(end) => tokio::time::sleep_until(end.into()).await,
                None => future::pending().await,
            }
        };
        let (kind, detail) = tokio::select! {
            () = draining.cancelled() => {
                (ErrorKind::Unavailable, "the server ends; call again, perhaps another one answers")
            }
            () = service.keys.ended(caller) => {
                (ErrorKind::Unauthorized, "the key was revoked or has expired; ask an admin for another")
            }
            () = deadline => (ErrorKind::DeadlinePassed, "the deadline of the call has passed"),
        };
        Err(status::status(kind, detail, kind.retry_after()))
    };
    // The end of either ends both: what is over is told once.
    let answers = answers.map(Some).chain(stream::iter([None]));
    let over = stream::once(over).map(Some).chain(stream::iter([None]));
    let both = stream::select(answers, over).take_while(|next| future::ready(next.is_some()));
    Box::pin(both.filter_map(future::ready))
}
