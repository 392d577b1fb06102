//! Retries while the store is unavailable, for example while its database restarts.

use std::time::{Duration, Instant};

use backon::{ConstantBuilder, Retryable};
use whereabouts_store::StoreError;

/// The pause between two calls.
const PAUSE: Duration = Duration::from_millis(500);

/// How long a read is retried. A read that fails costs an attempt of the job, which is tried again.
const READ_LIMIT: Duration = Duration::from_secs(30);

/// How long a write is retried. What a write that fails should have kept is lost.
const WRITE_LIMIT: Duration = Duration::from_secs(24 * 3600);

/// Retries a read for half a minute while the store is unavailable.
pub(super) async fn retry_read<T, F>(read: impl FnMut() -> F) -> Result<T, StoreError>
where
    F: Future<Output = Result<T, StoreError>>,
{
    retry_for(READ_LIMIT, read).await
}

/// Retries a write for a day while the store is unavailable. If it fails for good, the log says that
/// `what` is lost.
pub(super) async fn retry_write<F>(what: &str, write: impl FnMut() -> F)
where
    F: Future<Output = Result<(), StoreError>>,
{
    if let Err(error) = retry_for(WRITE_LIMIT, write).await {
        tracing::error!(%error, "the store did not record {what}");
    }
}

/// Retries a call while the store is unavailable, until `limit` has passed.
///
/// # Errors
/// The last error of the call.
pub async fn retry_for<T, F>(limit: Duration, call: impl FnMut() -> F) -> Result<T, StoreError>
where
    F: Future<Output = Result<T, StoreError>>,
{
    let began = Instant::now();
    call.retry(ConstantBuilder::new().with_delay(PAUSE).without_max_times())
        .when(|error| matches!(error, StoreError::Unavailable(_)) && began.elapsed() < limit)
        .notify(|error, _| tracing::warn!(%error, "the store is unavailable; retrying"))
        .await
}
