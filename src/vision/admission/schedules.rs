//! Permits under many thread schedules.

use std::sync::atomic::{AtomicUsize, Ordering};

use futures_util::poll;
use whereabouts_schedules::{JoinHandle, block_on, check, spawn, yield_now, yield_once};

use super::tests::{admission, request};
use super::*;

/// The number of permits in every test.
const PERMITS: usize = 2;

/// Checks with a clock that stands still, so that no request waits too long.
fn check_at_one_time(test: impl Fn() + Send + Sync + Clone + 'static) {
    let mut clock = tokio::runtime::Builder::new_current_thread();
    let runtime = clock.enable_time().start_paused(true).build().unwrap();
    let _entered = runtime.enter();
    check(test);
}

/// Holds a permit for a moment.
fn use_permit(permit: Permit, in_use: &AtomicUsize) {
    assert!(in_use.fetch_add(1, Ordering::SeqCst) < PERMITS, "more permits than there are");
    yield_now();
    in_use.fetch_sub(1, Ordering::SeqCst);
    drop(permit);
}

fn caller(
    admission: &Admission,
    in_use: &Arc<AtomicUsize>,
    class: WorkClass,
) -> JoinHandle<Result<(), RejectReason>> {
    let (admission, in_use) = (admission.clone(), Arc::clone(in_use));
    spawn(move || {
        let acquired = block_on(admission.acquire(request(class)));
        acquired.map(|permit| use_permit(permit, &in_use)).map_err(|rejected| rejected.reason)
    })
}

/// Whether all permits are free and no request is waiting.
fn is_idle(admission: &Admission) -> bool {
    admission.levels() == AdmissionLevels { permits: PERMITS, ..Default::default() }
}

#[test]
fn every_request_gets_a_permit_and_no_permit_is_given_twice() {
    check_at_one_time(|| {
        let (admission, in_use) = (admission(PERMITS, 9), Arc::default());
        let classes = [WorkClass::Localize, WorkClass::Index, WorkClass::Background];
        let callers = classes.map(|class| [(); 2].map(|()| caller(&admission, &in_use, class)));
        for caller in callers.into_iter().flatten() {
            assert_eq!(caller.join().unwrap(), Ok(()));
        }
        assert!(is_idle(&admission));
    });
}

#[test]
fn a_caller_that_leaves_takes_no_permit_with_it() {
    check_at_one_time(|| {
        let (admission, in_use) = (admission(PERMITS, 9), Arc::default());
        let staying = [(); 3].map(|()| caller(&admission, &in_use, WorkClass::Localize));
        let leaving = [(); 3].map(|()| {
            let admission = admission.clone();
            spawn(move || {
                block_on(async {
                    let mut entering = Box::pin(admission.acquire(request(WorkClass::Index)));
                    let _ = poll!(&mut entering);
                    yield_once().await;
                });
            })
        });
        for caller in staying {
            assert_eq!(caller.join().unwrap(), Ok(()));
        }
        leaving.into_iter().for_each(|caller| caller.join().unwrap());
        assert!(is_idle(&admission));
    });
}

#[test]
fn an_overfull_queue_rejects_and_evicts_but_never_grows() {
    check_at_one_time(|| {
        let (admission, in_use) = (admission(PERMITS, 1), Arc::default());
        let classes = [WorkClass::Index, WorkClass::Localize];
        let callers = classes.map(|class| [(); 3].map(|()| caller(&admission, &in_use, class)));
        let levels = admission.levels();
        assert!(levels.localize + levels.index <= 1);
        for caller in callers.into_iter().flatten() {
            assert!(matches!(caller.join().unwrap(), Ok(()) | Err(RejectReason::QueueFull)));
        }
        assert!(is_idle(&admission));
    });
}

#[test]
fn background_work_never_overtakes_a_waiting_frame() {
    check_at_one_time(|| {
        let admission = admission(PERMITS, 9);
        let acquire = |class| block_on(admission.acquire(request(class)));
        let held = [(); PERMITS].map(|()| acquire(WorkClass::Localize).unwrap());
        let frame = {
            let admission = admission.clone();
            let mut frame =
                Box::pin(async move { admission.acquire(request(WorkClass::Localize)).await });
            assert!(block_on(async { poll!(&mut frame) }).is_pending());
            frame
        };
        let background = {
            let admission = admission.clone();
            spawn(move || {
                let permit = block_on(admission.acquire(request(WorkClass::Background))).unwrap();
                assert_eq!(admission.levels().localize, 0, "a frame is waiting");
                drop(permit);
            })
        };
        drop(held);
        drop(block_on(frame).unwrap());
        background.join().unwrap();
        assert!(is_idle(&admission));
    });
}
