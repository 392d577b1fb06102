//! One call where several jobs want the same answer at once.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::{Mutex, MutexGuard};
use tokio::sync::OnceCell;

use whereabouts_core::Digest;

type Cell<T> = Arc<OnceCell<T>>;

/// Answers that are on their way, by key.
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
    /// What `make` gives, or what another caller of the same key is making at the moment. If that
    /// one fails or leaves, the next takes its place.
    pub async fn join<F, E>(&self, key: Digest, make: impl FnOnce() -> F) -> Result<T, E>
    where
        F: Future<Output = Result<T, E>>,
    {
        let seat = self.board(key);
        seat.cell.get_or_try_init(make).await.cloned()
    }

    fn board(&self, key: Digest) -> Follower<'_, T> {
        let cell = Arc::clone(self.cells().entry(key).or_default());
        Follower { flights: self, key, cell }
    }

    fn cells(&self) -> MutexGuard<'_, HashMap<Digest, Cell<T>>> {
        self.cells.lock()
    }
}

/// One caller's share in a flight; the last one to leave ends it.
struct Follower<'a, T: Clone> {
    flights: &'a SingleFlight<T>,
    key: Digest,
    cell: Cell<T>,
}

impl<T: Clone> Drop for Follower<'_, T> {
    fn drop(&mut self) {
        let mut cells = self.flights.cells();
        // The map's own and this one: cells are only cloned under the lock.
        if Arc::strong_count(&self.cell) <= 2 {
            cells.remove(&self.key);
        }
    }
}

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
    async fn two_at_once_share_one_answer() {
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
    async fn when_the_first_leaves_the_second_takes_its_place() {
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
    async fn nothing_is_kept_after_the_last_has_left() {
        let flights = SingleFlight::<u8>::default();
        let failed = flights.join(key(), || async { Err("down") }).await;
        assert_eq!(failed, Err("down"));
        let again = flights.join(key(), || async { Ok::<_, &str>(9) }).await;
        assert_eq!(again, Ok(9));
        assert!(flights.cells().is_empty());
    }
}
