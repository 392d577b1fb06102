//! The pool under many thread schedules.

use std::sync::atomic::{AtomicUsize, Ordering};

use futures_util::poll;
use whereabouts_schedules::{JoinHandle, block_on, check, spawn, yield_now};

use super::*;

fn pool(threads: usize, capacity: usize) -> (CpuPool, Vec<JoinHandle<()>>) {
    let pool = CpuPool::without_threads(0, capacity);
    let thread = |_| {
        let queue = Arc::clone(&pool.0.0);
        spawn(move || queue.work())
    };
    let threads = (0..threads).map(thread).collect();
    (pool, threads)
}

#[test]
fn every_job_is_run_or_refused_and_the_threads_end_with_the_pool() {
    check(|| {
        let (pool, threads) = pool(2, 1);
        let callers = [1, 2, 3].map(|number| {
            let pool = pool.clone();
            spawn(move || {
                for number in [number, 10 * number] {
                    let result = block_on(pool.run(move || number));
                    assert!(result == Ok(number) || result == Err(Overloaded.into()));
                }
            })
        });
        drop(pool);
        callers.into_iter().chain(threads).for_each(|thread| thread.join().unwrap());
    });
}

#[test]
fn an_idle_pool_has_run_every_job_that_was_queued() {
    check(|| {
        let (pool, threads) = pool(2, 4);
        let ended = Arc::new(AtomicUsize::new(0));
        let queued: Vec<_> = (0..3)
            .map(|_| {
                let (pool, ended) = (pool.clone(), Arc::clone(&ended));
                let job = move || {
                    yield_now();
                    ended.fetch_add(1, Ordering::SeqCst);
                };
                let mut queued = Box::pin(async move { pool.run(job).await });
                let _ = block_on(async { poll!(&mut queued) });
                queued
            })
            .collect();
        pool.wait_until_idle(Duration::MAX);
        assert_eq!(ended.load(Ordering::SeqCst), queued.len());
        drop(queued);
        drop(pool);
        threads.into_iter().for_each(|thread| thread.join().unwrap());
    });
}
