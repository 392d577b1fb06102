//! A fixed number of threads for work that would block the async runtime, with a bounded queue.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread;
use std::time::Duration;

use parking_lot::{Condvar, Mutex};
use tokio::sync::oneshot;

type Work = Box<dyn FnOnce() + Send>;

/// Threads that run one piece of work after another.
///
/// Work that waits is bounded: when the queue is full, [`CpuPool::run`] refuses at once. Work
/// whose caller has gone is dropped unrun. The threads end when the pool is dropped.
#[derive(Debug, Clone)]
pub struct CpuPool {
    queue: SyncSender<Work>,
    running: Arc<Running>,
}

/// How much work is being done at the moment.
#[derive(Debug, Default)]
struct Running {
    count: Mutex<usize>,
    /// Told when a piece of work has ended.
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

/// Why work gave no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// It was not taken.
    #[error(transparent)]
    Overloaded(#[from] Overloaded),
    /// It was taken and broke off: a bug in the work, or the pool is gone.
    #[error("the work broke off")]
    Aborted,
}

impl CpuPool {
    /// Starts `threads` threads named `name`; at most `queue` pieces of work wait for them.
    pub fn new(name: &str, threads: usize, queue: usize) -> std::io::Result<Self> {
        let (sender, receiver) = sync_channel::<Work>(queue);
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

    /// Runs `work` on one of the threads and waits for what it returns.
    pub async fn run<T, F>(&self, work: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let (answer, result) = oneshot::channel();
        let task: Work = Box::new(move || {
            if !answer.is_closed() {
                let _ = answer.send(work());
            }
        });
        self.queue.try_send(task).map_err(|error| match error {
            TrySendError::Full(_) => PoolError::Overloaded(Overloaded),
            TrySendError::Disconnected(_) => PoolError::Aborted,
        })?;
        result.await.map_err(|_| PoolError::Aborted)
    }

    /// Blocks until no work is being done, but no longer than `longest`. A process that ends while a
    /// library of another language works is ended by that library, and not with its own exit code.
    pub fn wait_until_idle(&self, longest: Duration) {
        let mut count = self.running.count.lock();
        let _ = self.running.ended.wait_while_for(&mut count, |count| *count > 0, longest);
    }
}

fn run_all(receiver: &Mutex<Receiver<Work>>, running: &Running) {
    loop {
        let next = receiver.lock().recv();
        let Ok(work) = next else { return };
        running.change(|count| *count += 1);
        // A panic in one piece of work must not take the thread from all the others.
        if std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).is_err() {
            tracing::error!("work on a pool thread panicked; its caller was told");
        }
        running.change(|count| *count -= 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    #[tokio::test]
    async fn a_full_queue_refuses_at_once() {
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
    async fn a_panic_reaches_its_caller_and_spares_the_thread() {
        let pool = CpuPool::new("test", 1, 4).unwrap();
        assert_eq!(pool.run(|| -> u8 { panic!("on purpose") }).await, Err(PoolError::Aborted));
        assert_eq!(pool.run(|| 7).await, Ok(7));
    }

    #[tokio::test]
    async fn idle_is_when_work_has_ended_even_if_its_caller_has_gone() {
        let pool = CpuPool::new("test", 1, 4).unwrap();
        let (started, has_started) = oneshot::channel();
        let (release, wait) = mpsc::channel::<()>();
        let mut work = Box::pin(pool.run(move || {
            let _ = started.send(());
            wait.recv().is_ok()
        }));
        assert!(futures_util::poll!(&mut work).is_pending());
        has_started.await.unwrap();
        drop(work);
        let waiting = pool.clone();
        let idle = thread::spawn(move || waiting.wait_until_idle(Duration::from_secs(60)));
        assert!(!idle.is_finished());
        release.send(()).unwrap();
        idle.join().unwrap();
        assert_eq!(*pool.running.count.lock(), 0);
    }
}
