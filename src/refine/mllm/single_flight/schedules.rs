//! Flights under many thread schedules.

use std::sync::atomic::{AtomicUsize, Ordering};

use futures_util::poll;
use whereabouts_schedules::{block_on, check, spawn, yield_once};

use super::*;

/// One key, and the computations for it.
#[derive(Default)]
struct Computing {
    flights: SingleFlight<usize>,
    running: AtomicUsize,
    results: AtomicUsize,
}

impl Computing {
    /// Joins the flight. A computation that succeeds returns how many have succeeded by then.
    async fn join(&self, succeed: bool) -> Result<usize, &'static str> {
        let make = || async {
            let _running = Running::new(&self.running);
            yield_once().await;
            match succeed {
                true => Ok(self.results.fetch_add(1, Ordering::SeqCst) + 1),
                false => Err("down"),
            }
        };
        self.flights.join(Digest::of(b"pair"), make).await
    }
}

/// Counts a computation until it ends or is cancelled.
struct Running<'a>(&'a AtomicUsize);

impl<'a> Running<'a> {
    fn new(running: &'a AtomicUsize) -> Self {
        assert_eq!(running.fetch_add(1, Ordering::SeqCst), 0, "two callers compute at a time");
        Self(running)
    }
}

impl Drop for Running<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

#[test]
fn one_caller_computes_at_a_time_and_the_flight_ends_with_the_last() {
    check(|| {
        let computing = Arc::new(Computing::default());
        let callers = [true, true, false].map(|succeed| {
            let computing = Arc::clone(&computing);
            spawn(move || block_on(computing.join(succeed)))
        });
        for caller in callers {
            let result = caller.join().unwrap();
            assert!(matches!(result, Ok(1..=2) | Err("down")), "{result:?}");
        }
        assert!(computing.flights.cells().is_empty());
    });
}

#[test]
fn callers_that_overlap_share_one_result() {
    check(|| {
        let computing = Arc::new(Computing::default());
        let first = computing.flights.follow(Digest::of(b"pair"));
        let callers = [(); 3].map(|()| {
            let computing = Arc::clone(&computing);
            spawn(move || block_on(computing.join(true)))
        });
        callers.into_iter().for_each(|caller| assert_eq!(caller.join().unwrap(), Ok(1)));
        drop(first);
        assert!(computing.flights.cells().is_empty());
    });
}

#[test]
fn a_cancelled_caller_leaves_no_other_waiting() {
    check(|| {
        let computing = Arc::new(Computing::default());
        let leaving = Arc::clone(&computing);
        let leaving = spawn(move || {
            block_on(async {
                let mut caller = Box::pin(leaving.join(true));
                let _ = poll!(&mut caller);
                yield_once().await;
            });
        });
        let staying = [(); 2].map(|()| {
            let computing = Arc::clone(&computing);
            spawn(move || block_on(computing.join(true)))
        });
        staying.into_iter().for_each(|caller| assert!(caller.join().unwrap().is_ok()));
        leaving.join().unwrap();
        assert!(computing.flights.cells().is_empty());
    });
}
