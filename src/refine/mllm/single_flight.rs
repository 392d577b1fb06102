//! Single flight: concurrent jobs that need the same result share one computation.

use std::collections::HashMap;
use std::sync::Arc;

use tokio::sync::OnceCell;

use whereabouts_core::Digest;

use crate::sync::{Mutex, MutexGuard};

type Cell<T> = Arc<OnceCell<T>>;

/// Computations in progress, by key.
#[derive(Debug)]
pub struct SingleFlight<T> {
    cells: Mutex<HashMap<Digest, Cell<T>>>,
}

impl<T> Default for SingleFlight<T> {
    fn default() -> Self {
        Self { cells: Mutex::default() }
    }
}

impl<T: Clone> SingleFlight<T> {
    /// Runs `make`, or waits for the result of another caller with the same key. If that caller fails or is
    /// cancelled, the next one runs its own `make`.
    pub async fn join<F, E>(&self, key: Digest, make: impl FnOnce() -> F) -> Result<T, E>
    where
        F: Future<Output = Result<T, E>>,
    {
        let follower = self.follow(key);
        follower.cell.get_or_try_init(make).await.cloned()
    }

    fn follow(&self, key: Digest) -> Follower<'_, T> {
        let cell = Arc::clone(self.cells().entry(key).or_default());
        Follower { flights: self, key, cell }
    }

    fn cells(&self) -> MutexGuard<'_, HashMap<Digest, Cell<T>>> {
        self.cells.lock()
    }
}

/// One caller of a flight. Dropping the last one removes the flight.
struct Follower<'a, T: Clone> {
    flights: &'a SingleFlight<T>,
    key: Digest,
    cell: Cell<T>,
}

impl<T: Clone> Drop for Follower<'_, T> {
    fn drop(&mut self) {
        let mut cells = self.flights.cells();
        // Two references are the map's and this one's; cells are cloned under the lock only.
        if Arc::strong_count(&self.cell) <= 2 {
            cells.remove(&self.key);
        }
    }
}

#[cfg(test)]
mod schedules;

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::poll;
    use std::convert::Infallible;
    use std::pin::pin;
    use tokio::sync::oneshot;

    fn key() -> Digest {
        Digest::of(b"pair")
    }

    #[tokio::test]
    async fn concurrent_callers_share_one_result() {
        let flights = SingleFlight::<u8>::default();
        let (answer, wait) = oneshot::channel();
        let mut first =
            pin!(flights.join(key(), || async { Ok::<_, Infallible>(wait.await.unwrap()) }));
        assert!(poll!(&mut first).is_pending());
        let second = async { Err::<u8, _>("it was called twice") };
        let mut second = pin!(flights.join(key(), || second));
        assert!(poll!(&mut second).is_pending());
        answer.send(7).unwrap();
        assert_eq!((first.await, second.await), (Ok(7), Ok(7)));
    }

    #[tokio::test]
    async fn when_the_first_caller_is_cancelled_the_second_takes_over() {
        let flights = SingleFlight::<u8>::default();
        let mut second = pin!(flights.join(key(), || async { Ok::<_, Infallible>(8) }));
        {
            let waiting = std::future::pending::<Result<u8, Infallible>>();
            let mut first = pin!(flights.join(key(), || waiting));
            assert!(poll!(&mut first).is_pending());
            assert!(poll!(&mut second).is_pending());
        }
        assert_eq!(second.await, Ok(8));
    }

    #[tokio::test]
    async fn a_flight_is_removed_with_its_last_caller() {
        let flights = SingleFlight::<u8>::default();
        let failed = flights.join(key(), || async { Err("down") }).await;
        assert_eq!(failed, Err("down"));
        let again = flights.join(key(), || async { Ok::<_, &str>(9) }).await;
        assert_eq!(again, Ok(9));
        assert!(flights.cells().is_empty());
    }
}
