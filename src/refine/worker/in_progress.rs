//! The jobs that a worker has in progress, and their turns to use this machine.

use std::collections::HashMap;
use std::future::pending;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::sync::broadcast::{Receiver, error::RecvError};
use tokio::sync::watch;
use tokio::task::{Id, JoinSet};
use uuid::Uuid;
use whereabouts_store::StoreError;

/// Jobs, each in a task of its own. Dropping this aborts them.
#[derive(Default)]
pub(super) struct InProgress {
    tasks: JoinSet<Result<(), StoreError>>,
    ids: HashMap<Id, Uuid>,
}

impl InProgress {
    pub fn spawn(
        &mut self,
        job: Uuid,
        work: impl Future<Output = Result<(), StoreError>> + Send + 'static,
    ) {
        let task = self.tasks.spawn(work);
        self.ids.insert(task.id(), job);
    }

    pub fn len(&self) -> usize {
        self.tasks.len()
    }

    pub fn is_empty(&self) -> bool {
        self.tasks.is_empty()
    }

    /// Returns when a job ends. Dropping the future loses nothing.
    pub async fn one_ends(&mut self) {
        let (task, failure) = match self.tasks.join_next_with_id().await {
            Some(Ok((task, outcome))) => (task, outcome.err().map(|error| error.to_string())),
            // Its lease will expire, and the job is then refined again.
            Some(Err(error)) => (error.id(), Some(error.to_string())),
            None => return,
        };
        let job = self.ids.remove(&task).unwrap_or_default();
        if let Some(error) = failure {
            tracing::error!(%job, error, "the outcome of a job could not be recorded");
        }
    }

    /// Returns when a job changes that is not in progress here. Each step of those that are changes them, and none
    /// of these can be claimed.
    pub async fn others_change(&self, changes: &mut Receiver<Uuid>) {
        loop {
            match changes.recv().await {
                Ok(job) if self.ids.values().any(|known| *known == job) => {}
                Err(RecvError::Closed) => return pending().await,
                Ok(_) | Err(RecvError::Lagged(_)) => return,
            }
        }
    }
}

/// Counts the jobs that use this machine.
pub(super) struct Turns {
    most: usize,
    taken: Arc<watch::Sender<usize>>,
}

impl Turns {
    pub fn new(most: usize) -> Self {
        Self { most, taken: Arc::default() }
    }

    pub fn has_any(&self) -> bool {
        *self.taken.borrow() < self.most
    }

    /// Returns once [`Self::has_any`].
    pub async fn any(&self) {
        // Cannot fail, because the sender lives as long as `self`.
        let _ = self.taken.subscribe().wait_for(|taken| *taken < self.most).await;
    }

    /// Takes a turn for a job.
    pub fn take(&self) -> Turn {
        self.taken.send_modify(|taken| *taken += 1);
        Turn { taken: Arc::clone(&self.taken), is_lent: AtomicBool::new(false) }
    }
}

/// A job's turn to use this machine.
pub(super) struct Turn {
    taken: Arc<watch::Sender<usize>>,
    is_lent: AtomicBool,
}

impl Turn {
    /// Lends the turn to another job while this one waits for a network. Taking it back does not wait: there may then
    /// be more jobs than turns, and no other is claimed until there are fewer.
    pub fn lend(&self, lend: bool) {
        if self.is_lent.swap(lend, Ordering::AcqRel) != lend {
            self.taken.send_modify(|taken| *taken = if lend { *taken - 1 } else { *taken + 1 });
        }
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        self.lend(true);
    }
}
