//! Group commit: changes that arrive together become durable together.

use std::thread;

use tokio::sync::{mpsc, oneshot};

use super::super::StoreError;
use super::mark::CommitWatermark;
use super::segments::VectorFiles;
use super::trees::Trees;
use std::sync::Arc;

/// The thread through which every change goes, one after another, so that a change may read
/// before it writes.
pub(super) struct Writer {
    queue: mpsc::Sender<Change>,
}

/// Applies a change, and returns what to do once it is durable, or is known not to be.
type Change = Box<dyn FnOnce(&Trees, &mut Touched) -> Durable + Send>;
type Durable = Box<dyn FnOnce(Result<(), StoreError>) + Send>;

/// Files that must be synced before the records that point into them.
#[derive(Default)]
pub(super) struct Touched {
    pub vectors: Vec<Arc<VectorFiles>>,
}

impl Writer {
    /// Starts the thread; it ends when the writer is dropped and the queue is empty.
    pub fn start(trees: Trees, mark: CommitWatermark, batch: usize) -> Result<Self, StoreError> {
        let (queue, changes) = mpsc::channel(batch.max(1));
        thread::Builder::new()
            .name("store-writer".into())
            .spawn(move || run(&trees, mark, changes, batch.max(1)))
            .map_err(|error| StoreError::Failed(error.to_string()))?;
        Ok(Self { queue })
    }

    /// Applies `change` and waits until it is on disk. `publish` runs right then, before the next
    /// change is applied, and even if the caller has gone.
    pub async fn commit<T, F, P>(&self, change: F, publish: P) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&Trees, &mut Touched) -> Result<T, StoreError> + Send + 'static,
        P: FnOnce(&T) + Send + 'static,
    {
        let (answer, result) = oneshot::channel();
        let change: Change = Box::new(move |trees, touched| {
            let applied = change(trees, touched);
            Box::new(move |flushed: Result<(), StoreError>| {
                let outcome = applied.and_then(|value| flushed.map(|()| value));
                if let Ok(value) = &outcome {
                    publish(value);
                }
                let _ = answer.send(outcome);
            })
        });
        let stopped = || StoreError::Failed("the store has been closed".into());
        self.queue.send(change).await.map_err(|_| stopped())?;
        result.await.map_err(|_| stopped())?
    }
}

fn run(
    trees: &Trees,
    mut mark: CommitWatermark,
    mut changes: mpsc::Receiver<Change>,
    batch: usize,
) {
    while let Some(first) = changes.blocking_recv() {
        let mut touched = Touched::default();
        let mut waiting = vec![first(trees, &mut touched)];
        while waiting.len() < batch
            && let Ok(change) = changes.try_recv()
        {
            waiting.push(change(trees, &mut touched));
        }
        let flushed = sync(trees, &touched, &mut mark);
        if let Err(error) = &flushed {
            tracing::error!(%error, "changes could not be made durable");
        }
        for durable in waiting {
            durable(match &flushed {
                Ok(()) => Ok(()),
                Err(error) => Err(StoreError::Failed(error.to_string())),
            });
        }
    }
}

fn sync(trees: &Trees, touched: &Touched, mark: &mut CommitWatermark) -> Result<(), StoreError> {
    touched.vectors.iter().try_for_each(|vectors| vectors.sync())?;
    mark.next(trees)?;
    trees.flush()?;
    mark.note();
    Ok(())
}
