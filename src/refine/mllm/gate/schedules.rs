//! The gate under many thread schedules.

use std::sync::atomic::{AtomicUsize, Ordering};

use futures_util::poll;
use whereabouts_schedules::{block_on, check, spawn, yield_now, yield_once};

use super::*;

const BOUND: usize = 2;

fn place(job: u128) -> CallPlace {
    CallPlace::new(Priority::Normal, Uuid::from_u128(job))
}

/// Makes a call, and checks that no more are made at once than the bound.
fn call(gate: &Arc<CallGate>, passing: &AtomicUsize, job: u128) {
    let mut permit = block_on(gate.pass(place(job)));
    assert!(passing.fetch_add(1, Ordering::SeqCst) < BOUND, "too many calls at once");
    permit.sent(CallPurpose::Describe);
    yield_now();
    passing.fetch_sub(1, Ordering::SeqCst);
    if job.is_multiple_of(2) {
        permit.answered(Duration::from_secs(1));
    }
}

fn is_idle(gate: &CallGate) -> bool {
    let state = gate.state();
    state.permits == 0 && state.waiting.is_empty() && state.sent == 0 && state.wanted == 0
}

#[test]
fn never_more_calls_pass_than_the_bound_and_none_waits_for_ever() {
    check(|| {
        let gate = CallGate::new(BOUND, Duration::ZERO);
        let passing = Arc::new(AtomicUsize::new(0));
        let threads = [1, 2, 3].map(|job| {
            let (gate, passing) = (Arc::clone(&gate), Arc::clone(&passing));
            spawn(move || [job, job + 3].map(|job| call(&gate, &passing, job)))
        });
        for thread in threads {
            thread.join().unwrap();
        }
        assert!(is_idle(&gate));
    });
}

#[test]
fn a_call_that_gives_up_its_place_takes_no_permit_with_it() {
    check(|| {
        let gate = CallGate::new(1, Duration::ZERO);
        let leaving = [1, 2].map(|job| {
            let gate = Arc::clone(&gate);
            spawn(move || {
                block_on(async {
                    let mut waiting = Box::pin(gate.pass(place(job)));
                    let _ = poll!(&mut waiting);
                    yield_once().await;
                });
            })
        });
        let passing = AtomicUsize::new(0);
        call(&gate, &passing, 3);
        leaving.into_iter().for_each(|thread| thread.join().unwrap());
        call(&gate, &passing, 4);
        assert!(is_idle(&gate));
    });
}

#[test]
fn whoever_waits_for_room_is_woken_when_a_wanted_call_ends_or_the_limit_rises() {
    check(|| {
        let gate = CallGate::new(1, Duration::ZERO);
        let wanted = gate.want(2);
        let waiting = Arc::clone(&gate);
        let waiting = spawn(move || block_on(waiting.room()));
        let ending = spawn(move || drop(wanted));
        waiting.join().unwrap();
        ending.join().unwrap();
        assert!(gate.has_room() && is_idle(&gate));
    });
}
