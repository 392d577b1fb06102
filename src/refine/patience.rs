//! Patience with a store that is away for a while, as a database is that is being restarted.

use std::time::{Duration, Instant};

use whereabouts_store::StoreError;

/// The pause before it is asked or told again.
const PAUSE: Duration = Duration::from_millis(500);

/// What is asked can be asked again later: the job is then tried again.
const PATIENCE: Duration = Duration::from_secs(30);

/// What is told is lost otherwise.
const INSISTENCE: Duration = Duration::from_secs(24 * 3600);

/// Asks until there is an answer, for a while.
pub(super) async fn patiently<T, F>(ask: impl Fn() -> F) -> Result<T, StoreError>
where
    F: Future<Output = Result<T, StoreError>>,
{
    until(PATIENCE, ask).await
}

/// Tells what happened until that is written down, for a day. `what` is for the log.
pub(super) async fn insist<F>(what: &str, tell: impl Fn() -> F)
where
    F: Future<Output = Result<(), StoreError>>,
{
    if let Err(error) = until(INSISTENCE, tell).await {
        tracing::error!(%error, "the store cannot be told {what}");
    }
}

/// Asks or tells until there is an answer, for so long.
pub(super) async fn until<T, F>(limit: Duration, call: impl Fn() -> F) -> Result<T, StoreError>
where
    F: Future<Output = Result<T, StoreError>>,
{
    let began = Instant::now();
    loop {
        match call().await {
            Err(StoreError::Unavailable(why)) if began.elapsed() < limit => {
                tracing::warn!(why, "the store is away; trying again");
                tokio::time::sleep(PAUSE).await;
            }
            answer => return answer,
        }
    }
}
