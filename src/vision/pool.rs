//! A thread pool with a bounded queue, for work that would block the async runtime.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread;
use std::time::Duration;

use parking_lot::{Condvar, Mutex};
use tokio::sync::oneshot;

type Job = Box<dyn FnOnce() + Send>;

/// A fixed number of threads with a bounded queue.
///
/// When the queue is full, [`CpuPool::run`] fails at once. Jobs whose caller has left are dropped without being
/// run. The threads end when the last clone of the pool is dropped.
#[derive(Debug, Clone)]
pub struct CpuPool {
    queue: SyncSender<Job>,
    running: Arc<Running>,
}

/// The number of jobs that are running.
#[derive(Debug, Default)]
struct Running {
    count: Mutex<usize>,
    /// Notified when a job ends.
    ended: Condvar,
}

impl Running {
    fn change(&self, change: impl FnOnce(&mut usize)) {
        change(&mut self.count.lock());
        self.ended.notify_all();
    }
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
        let (sender, receiver) = sync_channel::<Job>(queue);
        let receiver = Arc::new(Mutex::new(receiver));
        let running = Arc::new(Running::default());
        for index in 0..threads.max(1) {
            let (receiver, running) = (Arc::clone(&receiver), Arc::clone(&running));
            thread::Builder::new()
                .name(format!("{name}-{index}"))
                .spawn(move || run_all(&receiver, &running))?;
        }
        Ok(Self { queue: sender, running })
    }

    /// Runs `job` on a pool thread and waits for its result.
    pub async fn run<T, F>(&self, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let (reply, result) = oneshot::channel();
        let queued: Job = Box::new(move || {
            if !reply.is_closed() {
                let _ = reply.send(job());
            }
        });
        self.queue.try_send(queued).map_err(|error| match error {
            TrySendError::Full(_) => PoolError::Overloaded(Overloaded),
            TrySendError::Disconnected(_) => PoolError::Aborted,
        })?;
        result.await.map_err(|_| PoolError::Aborted)
    }

    /// Blocks until no job is running, for at most `timeout`. If a process exits while a native library is
    /// still working, the library may crash and replace the exit code.
    pub fn wait_until_idle(&self, timeout: Duration) {
        let mut count = self.running.count.lock();
        let _ = self.running.ended.wait_while_for(&mut count, |count| *count > 0, timeout);
    }
}

fn run_all(receiver: &Mutex<Receiver<Job>>, running: &Running) {
    loop {
        let next = receiver.lock().recv();
        let Ok(job) = next else { return };
        running.change(|count| *count += 1);
        // A panicking job must not take its thread from the jobs behind it.
        if std::panic::catch_unwind(std::panic::AssertUnwindSafe(job)).is_err() {
            tracing::error!("a job on a pool thread panicked; its caller received an error");
        }
        running.change(|count| *count -= 1);
    }
}

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
        assert_eq!(*pool.running.count.lock(), 0);
    }
}
