//! Slots under many thread schedules.

use std::sync::atomic::{AtomicUsize, Ordering};

use whereabouts_schedules::{check, spawn, yield_now};

use super::*;

/// Has two requests on a connection, if there is a slot for it. Checks that the connection is not evicted during
/// a request and that at most `most` that are not evicted have requests.
fn connect(slots: &Slots, busy: &AtomicUsize) {
    let Some(slot) = slots.take() else { return };
    for _ in 0..2 {
        yield_now();
        slot.request_began();
        // A request may begin in the moment in which its connection is evicted; its client sees it fail.
        if !slot.evicted.is_cancelled() {
            let before = busy.fetch_add(1, Ordering::SeqCst);
            assert!(before < slots.shared.most, "more connections are open than allowed");
            yield_now();
            assert!(!slot.evicted.is_cancelled(), "a connection with a request was evicted");
            busy.fetch_sub(1, Ordering::SeqCst);
        }
        slot.request_ended();
    }
}

fn check_with(most: usize) {
    check(move || {
        let (slots, busy) = (Slots::new(most), Arc::new(AtomicUsize::new(0)));
        let clients = [(); 3].map(|()| {
            let (slots, busy) = (slots.clone(), Arc::clone(&busy));
            spawn(move || (0..3).for_each(|_| connect(&slots, &busy)))
        });
        clients.into_iter().for_each(|client| client.join().unwrap());
        let state = slots.shared.lock();
        assert_eq!((state.open, state.idle.len()), (0, 0), "a closed connection keeps a slot");
    });
}

#[test]
fn one_slot_is_never_held_twice_and_always_returned() {
    check_with(1);
}

#[test]
fn slots_are_never_held_twice_and_always_returned() {
    check_with(2);
}
