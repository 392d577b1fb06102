//! Ended jobs go, with their queries and frames: the first to end first, a few in each change, so that
//! no other change waits long.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use async_trait::async_trait;
use jiff::civil::Date;
use sled::Transactional;

use super::super::{JobRetention, RemovedJobs, Retention, StoreError};
use super::trees::{BlobOwner, Trees, blob_ref_key, ended_job, failed, transaction_failed};
use super::{EmbeddedStore, blocking};
use whereabouts_core::{Digest, MapName};

/// What one change took away.
#[derive(Default)]
struct Taken {
    removed: RemovedJobs,
    frames: Vec<Digest>,
}

#[async_trait]
impl Retention for EmbeddedStore {
    async fn remove_ended(
        &self,
        keep: JobRetention,
        batch: usize,
    ) -> Result<RemovedJobs, StoreError> {
        let counting = Arc::clone(&self.inner);
        let change = move |trees: &Trees, _: &mut _| take(trees, keep, &counting.ended, batch);
        let taken = self.inner.writer.commit(change, |_| {}).await?;
        let Taken { mut removed, frames } = taken;
        let inner = Arc::clone(&self.inner);
        // Not on the writer thread: files take their time.
        blocking(move || {
            let gone =
                frames.iter().map(|frame| inner.blobs.remove_unreferenced(frame, &inner.trees));
            removed.bytes = gone.sum();
            Ok(removed)
        })
        .await
    }

    async fn forget_usage(&self, before: Date) -> Result<(), StoreError> {
        let forget = move |trees: &Trees, _: &mut _| {
            for key in trees.usage.range(..before.to_string().into_bytes()).keys() {
                trees.usage.remove(key.map_err(failed)?).map_err(failed)?;
            }
            Ok(())
        };
        self.inner.writer.commit(forget, |()| {}).await
    }

    async fn collect_garbage(&self) -> Result<(), StoreError> {
        // Opening the folder does it, and every description that comes.
        Ok(())
    }

    async fn db_bytes(&self) -> Result<u64, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || inner.trees.bytes()).await
    }

    async fn index_bytes(&self) -> Result<Vec<(MapName, u64)>, StoreError> {
        let maps = self.inner.maps.read();
        Ok(maps.iter().map(|(name, live)| (name.clone(), live.index_bytes())).collect())
    }

    async fn free_bytes(&self) -> Option<u64> {
        let inner = Arc::clone(&self.inner);
        blocking(move || inner.blobs.free_bytes()).await.ok()
    }
}

/// Removes the records of up to `batch` of the jobs that have ended, and counts down.
fn take(
    trees: &Trees,
    keep: JobRetention,
    ended: &AtomicUsize,
    batch: usize,
) -> Result<Taken, StoreError> {
    let mut taken = Taken::default();
    for place in trees.ended.iter().keys().take(batch) {
        let place = place.map_err(failed)?;
        let Some((at, id)) = ended_job(&place) else {
            return Err(StoreError::Damaged("a job has ended at no time".into()));
        };
        let left = ended.load(Ordering::Relaxed);
        let count = match (keep.since, keep.most) {
            _ if at > keep.settled => break,
            (Some(since), _) if at < since => &mut taken.removed.by_age,
            (_, Some(most)) if left > most => &mut taken.removed.by_count,
            _ => break,
        };
        *count += 1;
        let record = trees.job(id)?;
        let frame = record.map(|record| {
            let reference = blob_ref_key(&record.query.digest, &BlobOwner::Query(record.query.id));
            (record.query.digest, reference)
        });
        (&trees.jobs, &trees.ended, &trees.blob_refs)
            .transaction(|(jobs, places, refs)| {
                jobs.remove(id.as_bytes())?;
                places.remove(&place)?;
                if let Some((_, reference)) = &frame {
                    refs.remove(reference.as_slice())?;
                }
                Ok(())
            })
            .map_err(transaction_failed)?;
        ended.fetch_sub(1, Ordering::Relaxed);
        taken.frames.extend(frame.map(|(digest, _)| digest));
    }
    Ok(taken)
}
