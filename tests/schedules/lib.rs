//! Checks synchronisation protocols under many thread schedules.
//!
//! [`Mutex`] and [`Condvar`] replace those of parking_lot in the unit tests of the members that wait for each
//! other by hand. Those that are created within [`check`] give control to shuttle, which chooses the thread that
//! runs next at every lock, wait and notification and fails on a deadlock or a panic; all others are parking_lot's.
//! Channels and semaphores of tokio are used as they are: to shuttle, each of their operations is one step, and
//! their wakers are shuttle's where a future runs in [`block_on`].
//!
//! shuttle instead of loom: loom can interleave tokio's channels only if all of tokio is compiled for it.

mod locks;

use std::cell::Cell;

use shuttle::scheduler::{PctScheduler, RandomScheduler};
use shuttle::{Config, Runner};

pub use self::locks::{Condvar, Mutex, MutexGuard};
pub use shuttle::future::{block_on, yield_now as yield_once};
pub use shuttle::thread::{JoinHandle, spawn, yield_now};

/// Schedules that [`check`] tries with each of two strategies.
const SCHEDULES: usize = 1_000;

/// Preemptions that the second strategy places, which finds bugs that need few but exact ones.
const PREEMPTIONS: usize = 3;

thread_local! {
    static CHECKING: Cell<bool> = const { Cell::new(false) };
}

/// Whether the calling code runs within [`check`].
fn is_checking() -> bool {
    CHECKING.get()
}

/// Runs `test` under many schedules. Panics if one of them panics or leaves a thread waiting for ever; the message
/// ends with the schedule, which `shuttle::replay` repeats.
pub fn check(test: impl Fn() + Send + Sync + Clone + 'static) {
    struct Checking;
    impl Drop for Checking {
        fn drop(&mut self) {
            CHECKING.set(false);
        }
    }
    CHECKING.set(true);
    let _checking = Checking;
    Runner::new(RandomScheduler::new(SCHEDULES), Config::new()).run(test.clone());
    Runner::new(PctScheduler::new(PREEMPTIONS, SCHEDULES), Config::new()).run(test);
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    #[should_panic(expected = "an update was lost")]
    fn a_lost_update_is_found() {
        check(|| {
            let number = Arc::new(Mutex::new(0));
            let threads = [(); 2].map(|()| {
                let number = Arc::clone(&number);
                spawn(move || {
                    let read = *number.lock();
                    *number.lock() = read + 1;
                })
            });
            threads.into_iter().for_each(|thread| thread.join().unwrap());
            assert_eq!(*number.lock(), 2, "an update was lost");
        });
    }

    #[test]
    #[should_panic(expected = "deadlock")]
    fn a_lost_notification_is_found() {
        check(|| {
            let shared = Arc::new((Mutex::new(false), Condvar::new()));
            let setter = Arc::clone(&shared);
            let setting = spawn(move || {
                setter.1.notify_one();
                *setter.0.lock() = true;
            });
            let mut set = shared.0.lock();
            while !*set {
                shared.1.wait(&mut set);
            }
            drop(set);
            setting.join().unwrap();
        });
    }

    #[test]
    fn locks_outside_of_a_check_are_ordinary_ones() {
        let shared = Arc::new((Mutex::new(0), Condvar::new()));
        let adding = Arc::clone(&shared);
        let thread = std::thread::spawn(move || {
            *adding.0.lock() += 1;
            adding.1.notify_all();
        });
        let mut number = shared.0.lock();
        while *number == 0 {
            shared.1.wait(&mut number);
        }
        thread.join().unwrap();
    }

    #[test]
    fn every_schedule_runs_the_whole_test() {
        let runs = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&runs);
        check(move || {
            let threads = [(); 2].map(|()| spawn(yield_now));
            threads.into_iter().for_each(|thread| thread.join().unwrap());
            counted.fetch_add(1, Ordering::Relaxed);
        });
        assert_eq!(runs.load(Ordering::Relaxed), 2 * SCHEDULES);
        assert!(!is_checking());
    }
}
