//! Group commit: changes that arrive together become durable with one flush.

use std::sync::Arc;
use std::thread;

use tokio::sync::{mpsc, oneshot};

use super::super::StoreError;
use super::segments::VectorFiles;
use super::trees::Trees;
use super::watermark::CommitWatermark;

/// The thread that applies all changes one after another, so that a change can read before it
/// writes.
pub(super) struct Writer {
    queue: mpsc::Sender<Change>,
}

/// Applies a change, and returns what to do once it is durable or the flush has failed.
type Change = Box<dyn FnOnce(&Trees, &mut Touched) -> AfterFlush + Send>;
type AfterFlush = Box<dyn FnOnce(Result<(), StoreError>) + Send>;

/// Files that must be synced before the records that refer to them.
#[derive(Default)]
pub(super) struct Touched {
    pub vectors: Vec<Arc<VectorFiles>>,
}

impl Writer {
    /// Starts the thread. It ends when the writer is dropped and the queue is empty.
    pub fn start(
        trees: Trees,
        mut watermark: CommitWatermark,
        batch: usize,
    ) -> Result<Self, StoreError> {
        Self::start_with(trees, batch, move |trees, touched| flush(trees, touched, &mut watermark))
    }

    fn start_with(
        trees: Trees,
        batch: usize,
        flush: impl FnMut(&Trees, &Touched) -> Result<(), StoreError> + Send + 'static,
    ) -> Result<Self, StoreError> {
        let (queue, changes) = mpsc::channel(batch.max(1));
        thread::Builder::new()
            .name("store-writer".into())
            .spawn(move || run(&trees, changes, batch.max(1), flush))
            .map_err(|error| StoreError::Failed(error.to_string()))?;
        Ok(Self { queue })
    }

    /// Applies `change` and waits until it is on disk. `publish` runs as soon as it is, before the
    /// next change is applied, and even if the caller was cancelled.
    pub async fn commit<T, F, P>(&self, change: F, publish: P) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&Trees, &mut Touched) -> Result<T, StoreError> + Send + 'static,
        P: FnOnce(&T) + Send + 'static,
    {
        let (reply, result) = oneshot::channel();
        let change: Change = Box::new(move |trees, touched| {
            let applied = change(trees, touched);
            Box::new(move |flushed: Result<(), StoreError>| {
                let committed = applied.and_then(|value| flushed.map(|()| value));
                if let Ok(value) = &committed {
                    publish(value);
                }
                let _ = reply.send(committed);
            })
        });
        let stopped = || StoreError::Failed("the store has been closed".into());
        self.queue.send(change).await.map_err(|_| stopped())?;
        result.await.map_err(|_| stopped())?
    }
}

fn run(
    trees: &Trees,
    mut changes: mpsc::Receiver<Change>,
    batch: usize,
    mut flush: impl FnMut(&Trees, &Touched) -> Result<(), StoreError>,
) {
    while let Some(first) = changes.blocking_recv() {
        let mut touched = Touched::default();
        let mut applied = vec![first(trees, &mut touched)];
        while applied.len() < batch
            && let Ok(change) = changes.try_recv()
        {
            applied.push(change(trees, &mut touched));
        }
        let flushed = flush(trees, &touched);
        if let Err(error) = &flushed {
            tracing::error!(%error, "changes could not be made durable");
        }
        for after_flush in applied {
            after_flush(flushed.clone());
        }
    }
}

fn flush(
    trees: &Trees,
    touched: &Touched,
    watermark: &mut CommitWatermark,
) -> Result<(), StoreError> {
    touched.vectors.iter().try_for_each(|vectors| vectors.sync())?;
    watermark.next(trees)?;
    trees.flush()?;
    watermark.record();
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_change_of_a_failed_flush_gets_its_error_unchanged() {
        let dir = tempfile::tempdir().unwrap();
        let trees = Trees::open(dir.path(), 1 << 20).unwrap();
        let errors = [
            StoreError::Failed("cannot sync the segment: no space left on device".into()),
            StoreError::Damaged("the files are inconsistent".into()),
            StoreError::Full { free: 1, kept: 2 },
        ];
        for error in errors {
            let failure = error.clone();
            let writer =
                Writer::start_with(trees.clone(), 8, move |_, _| Err(failure.clone())).unwrap();
            let commit = || writer.commit(|_, _| Ok(()), |()| unreachable!("it is not durable"));
            let (first, second) = tokio::join!(commit(), commit());
            assert_eq!(first, Err(error.clone()));
            assert_eq!(second, Err(error));
        }
    }

    #[tokio::test]
    async fn a_refused_change_keeps_its_own_error_when_the_flush_fails() {
        let dir = tempfile::tempdir().unwrap();
        let trees = Trees::open(dir.path(), 1 << 20).unwrap();
        let flush = |_: &Trees, _: &Touched| Err(StoreError::Failed("no space left".into()));
        let writer = Writer::start_with(trees, 8, flush).unwrap();
        let refused = StoreError::QueueFull { limit: 3 };
        let error = refused.clone();
        let result: Result<(), _> = writer.commit(move |_, _| Err(error), |()| {}).await;
        assert_eq!(result, Err(refused));
    }
}
