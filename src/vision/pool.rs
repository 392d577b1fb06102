//! A thread pool with a bounded queue, for work that would block the async runtime.

use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use tokio::sync::oneshot;

use super::sync::{Condvar, Mutex};

type Job = Box<dyn FnOnce() + Send>;

/// A fixed number of threads with a bounded queue.
///
/// When the queue is full, [`CpuPool::run`] fails at once. Jobs whose caller has left are dropped without being
/// run. The threads end when the last clone of the pool is dropped.
#[derive(Debug, Clone)]
pub struct CpuPool(Arc<Handle>);

/// Closes the queue when the last clone of the pool is dropped.
#[derive(Debug)]
struct Handle(Arc<Queue>);

struct Queue {
    threads: usize,
    /// Maximum number of waiting jobs.
    capacity: usize,
    state: Mutex<State>,
    /// Notified when a job is queued, and when the pool is dropped.
    work_available: Condvar,
    /// Notified when the last job has ended.
    idle: Condvar,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Job>,
    /// Jobs that a thread has taken and not finished.
    running: usize,
    closed: bool,
}

/// The queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("all workers are busy and the queue is full")]
pub struct Overloaded;

/// Why a job returned no result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// The queue is full.
    #[error(transparent)]
    Overloaded(#[from] Overloaded),
    /// The job panicked, or the pool has been shut down.
    #[error("the job was aborted")]
    Aborted,
}

impl CpuPool {
    /// Starts `threads` threads named `name` with a queue of at most `queue` jobs.
    pub fn new(name: &str, threads: usize, queue: usize) -> std::io::Result<Self> {
        let threads = threads.max(1);
        let pool = Self::without_threads(threads, queue);
        for index in 0..threads {
            let queue = Arc::clone(&pool.0.0);
            thread::Builder::new().name(format!("{name}-{index}")).spawn(move || queue.work())?;
        }
        Ok(pool)
    }

    fn without_threads(threads: usize, capacity: usize) -> Self {
        let queue = Queue {
            threads,
            capacity,
            state: Mutex::default(),
            work_available: Condvar::new(),
            idle: Condvar::new(),
        };
        Self(Arc::new(Handle(Arc::new(queue))))
    }

    /// Returns the number of its threads.
    pub fn threads(&self) -> usize {
        self.0.0.threads
    }

    /// Runs `job` on a pool thread and waits for its result.
    pub async fn run<T, F>(&self, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let (reply, result) = oneshot::channel();
        self.0.0.push(Box::new(move || {
            if !reply.is_closed() {
                let _ = reply.send(job());
            }
        }))?;
        result.await.map_err(|_| PoolError::Aborted)
    }

    /// Blocks until no job is queued or running, for at most `timeout`. If a process exits while a native
    /// library is still working, the library may crash and replace the exit code.
    pub fn wait_until_idle(&self, timeout: Duration) {
        let Queue { state, idle, .. } = &*self.0.0;
        let is_busy = |state: &mut State| state.running > 0 || !state.waiting.is_empty();
        idle.wait_while_for(&mut state.lock(), is_busy, timeout);
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        self.0.state.lock().closed = true;
        self.0.work_available.notify_all();
    }
}

impl Queue {
    fn push(&self, job: Job) -> Result<(), Overloaded> {
        let mut state = self.state.lock();
        if state.waiting.len() >= self.capacity {
            return Err(Overloaded);
        }
        state.waiting.push_back(job);
        drop(state);
        self.work_available.notify_one();
        Ok(())
    }

    /// Runs one job after another until the pool is dropped and the queue is empty.
    fn work(&self) {
        while let Some(job) = self.take() {
            // A panicking job must not take its thread from the jobs behind it.
            if std::panic::catch_unwind(std::panic::AssertUnwindSafe(job)).is_err() {
                tracing::error!("a job on a pool thread panicked; its caller received an error");
            }
            self.finish();
        }
    }

    fn take(&self) -> Option<Job> {
        let mut state = self.state.lock();
        loop {
            if let Some(job) = state.waiting.pop_front() {
                state.running += 1;
                return Some(job);
            }
            if state.closed {
                return None;
            }
            self.work_available.wait(&mut state);
        }
    }

    fn finish(&self) {
        let mut state = self.state.lock();
        state.running -= 1;
        if state.running == 0 && state.waiting.is_empty() {
            self.idle.notify_all();
        }
    }
}

impl fmt::Debug for Queue {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Queue").field("capacity", &self.capacity).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod schedules;

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    #[tokio::test]
    async fn a_full_queue_fails_at_once() {
        let pool = CpuPool::new("test", 1, 1).unwrap();
        let (started, has_started) = oneshot::channel();
        let (release, wait) = mpsc::channel::<()>();
        let first = tokio::spawn({
            let pool = pool.clone();
            async move {
                pool.run(move || {
                    let _ = started.send(());
                    wait.recv().is_ok()
                })
                .await
            }
        });
        has_started.await.unwrap();
        let mut second = Box::pin(pool.run(|| 2));
        assert!(futures_util::poll!(&mut second).is_pending());
        assert_eq!(pool.run(|| 3).await, Err(PoolError::Overloaded(Overloaded)));
        release.send(()).unwrap();
        assert_eq!(first.await.unwrap(), Ok(true));
        assert_eq!(second.await, Ok(2));
    }

    #[tokio::test]
    async fn a_panic_is_reported_to_the_caller_and_the_thread_survives() {
        let pool = CpuPool::new("test", 1, 4).unwrap();
        assert_eq!(pool.run(|| -> u8 { panic!("on purpose") }).await, Err(PoolError::Aborted));
        assert_eq!(pool.run(|| 7).await, Ok(7));
    }

    #[tokio::test]
    async fn waiting_until_idle_includes_jobs_whose_caller_left() {
        let pool = CpuPool::new("test", 1, 4).unwrap();
        let (started, has_started) = oneshot::channel();
        let (release, wait) = mpsc::channel::<()>();
        let mut job = Box::pin(pool.run(move || {
            let _ = started.send(());
            wait.recv().is_ok()
        }));
        assert!(futures_util::poll!(&mut job).is_pending());
        has_started.await.unwrap();
        drop(job);
        let waiting = pool.clone();
        let idle = thread::spawn(move || waiting.wait_until_idle(Duration::from_secs(60)));
        assert!(!idle.is_finished());
        release.send(()).unwrap();
        idle.join().unwrap();
        assert_eq!(pool.0.0.state.lock().running, 0);
    }
}
