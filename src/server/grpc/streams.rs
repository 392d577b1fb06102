//! Response streams, and what ends them.

use std::pin::Pin;

use futures_util::{FutureExt, Stream, StreamExt, future, stream};
use tonic::Status;

use super::{CallContext, status};
use whereabouts_service::Readiness;

/// A stream of responses.
pub(super) type ResponseStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Passes responses on until they end, the server drains, the caller's key is revoked, or the deadline passes.
pub(super) fn until_over<T: Send + 'static>(
    responses: impl Stream<Item = Result<T, Status>> + Send + 'static,
    readiness: &Readiness,
    context: CallContext,
) -> ResponseStream<T> {
    let CallContext { service, caller, deadline, .. } = context;
    let over = service.over(readiness, caller, deadline).map(|why| Err(status::of(why)));
    // The end of either stream ends both; the reason is sent once.
    let responses = responses.map(Some).chain(stream::iter([None]));
    let over = stream::once(over).map(Some).chain(stream::iter([None]));
    let both = stream::select(responses, over).take_while(|next| future::ready(next.is_some()));
    Box::pin(both.filter_map(future::ready))
}
