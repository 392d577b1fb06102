//! Waiting for a condition instead of for a time.

use std::fmt::Display;
use std::time::{Duration, Instant};

/// The deadline of [`eventually`]: far longer than a busy machine needs, so that reaching it is a failure.
const DEADLINE: Duration = Duration::from_secs(60);

/// The pause between two attempts.
const PAUSE: Duration = Duration::from_millis(20);

/// Polls `attempt` until it returns a value. Panics after a minute.
pub async fn eventually<T>(mut attempt: impl AsyncFnMut() -> Option<T>) -> T {
    eventually_within(DEADLINE, async || attempt().await.ok_or("there is no value yet")).await
}

/// Polls `attempt` until it succeeds. Panics with the last error at the deadline.
pub async fn eventually_within<T, E: Display>(
    deadline: Duration,
    mut attempt: impl AsyncFnMut() -> Result<T, E>,
) -> T {
    let start = Instant::now();
    loop {
        match attempt().await {
            Ok(value) => return value,
            Err(error) => assert!(start.elapsed() < deadline, "not within {deadline:?}: {error}"),
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// Polls until `condition` holds. Panics after a minute.
pub async fn until(mut condition: impl AsyncFnMut() -> bool) {
    eventually(async || condition().await.then_some(())).await;
}
