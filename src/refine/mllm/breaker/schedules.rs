//! The breaker under many orders of calls and outcomes.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use whereabouts_schedules::{block_on, check, spawn, yield_now};

use super::*;

/// Makes a call and reports its outcome; `None` drops the call. Checks that it is the only probe, if it is one.
fn call(breaker: &Breaker, probes: &AtomicUsize, succeed: Option<bool>) -> Result<(), Open> {
    yield_now();
    let admission = block_on(breaker.admit())?;
    let is_probe = admission.probe;
    if is_probe {
        assert_eq!(probes.fetch_add(1, Ordering::SeqCst), 0, "two probes at a time");
    }
    yield_now();
    if is_probe {
        probes.fetch_sub(1, Ordering::SeqCst);
    }
    match succeed {
        Some(true) => admission.succeeded(),
        Some(false) => admission.failed(),
        None => drop(admission),
    }
    Ok(())
}

/// Calls from three threads: each succeeds, fails and is dropped, in another order.
fn call_from_three_threads(breaker: &Arc<Breaker>) -> Vec<Result<(), Open>> {
    let probes = Arc::new(AtomicUsize::new(0));
    let outcomes = [Some(false), None, Some(true)];
    let threads = [0, 1, 2].map(|first| {
        let (breaker, probes) = (Arc::clone(breaker), Arc::clone(&probes));
        spawn(move || [0, 1, 2].map(|turn| call(&breaker, &probes, outcomes[(first + turn) % 3])))
    });
    threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect()
}

#[test]
fn one_probe_at_a_time_and_every_call_that_waits_for_it_goes_on() {
    check(|| {
        // Opens at once, and lets a probe pass at once.
        let breaker = Arc::new(Breaker::new(1, Duration::ZERO));
        let results = call_from_three_threads(&breaker);
        assert!(results.iter().all(Result::is_ok), "an open breaker refused a probe: {results:?}");
        assert!(*breaker.state.borrow() != State::HalfOpen, "a probe was lost");
    });
}

#[test]
fn an_open_breaker_refuses_every_later_call() {
    check(|| {
        let breaker = Arc::new(Breaker::new(2, Duration::MAX / 4));
        let failing = [(); 2].map(|()| {
            let breaker = Arc::clone(&breaker);
            spawn(move || call(&breaker, &AtomicUsize::new(0), Some(false)))
        });
        let late = Arc::clone(&breaker);
        let late = spawn(move || call(&late, &AtomicUsize::new(0), None));
        for failing in failing {
            assert_eq!(failing.join().unwrap(), Ok(()));
        }
        let _ = late.join().unwrap();
        assert!(breaker.is_open());
        assert!(call(&breaker, &AtomicUsize::new(0), Some(true)).is_err());
    });
}
