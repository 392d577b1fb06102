//! Streams of answers, and what ends them.

use std::pin::Pin;

use futures_util::{FutureExt, Stream, StreamExt, future, stream};
use tonic::Status;

use super::{Asked, status};
use whereabouts_service::Readiness;

/// Answers, one after another.
pub(super) type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Answers until they end, the server drains, the caller may ask no more, or wants no more.
pub(super) fn until_over<T: Send + 'static>(
    answers: impl Stream<Item = Result<T, Status>> + Send + 'static,
    door: &Readiness,
    asked: Asked,
) -> Answers<T> {
    let Asked { service, caller, deadline, .. } = asked;
    let over = service.cancelled_by(door, caller, deadline).map(|why| Err(status::of(why)));
    // The end of either ends both: what is over is told once.
    let answers = answers.map(Some).chain(stream::iter([None]));
    let over = stream::once(over).map(Some).chain(stream::iter([None]));
    let both = stream::select(answers, over).take_while(|next| future::ready(next.is_some()));
    Box::pin(both.filter_map(future::ready))
}
