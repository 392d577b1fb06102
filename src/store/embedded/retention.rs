//! Retention: ended jobs are removed with their queries and frames, oldest first and in small batches,
//! so that other changes do not wait long.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use async_trait::async_trait;
use jiff::civil::Date;
use sled::Transactional;

use super::super::{JobRetention, RemovedJobs, Retention, StoreError};
use super::trees::{BlobOwner, Trees, blob_ref_key, ended_job, failed, transaction_failed};
use super::{EmbeddedStore, blocking};
use whereabouts_core::{Digest, MapName};

/// What one batch removed.
#[derive(Default)]
struct RemovedBatch {
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
        let change =
            move |trees: &Trees, _: &mut _| remove_batch(trees, keep, &counting.ended, batch);
        let RemovedBatch { mut removed, frames } = self.inner.writer.commit(change, |_| {}).await?;
        let inner = Arc::clone(&self.inner);
        // Deleting files is slow, so it does not happen on the writer thread.
        blocking(move || {
            let freed =
                frames.iter().map(|frame| inner.blobs.remove_unreferenced(frame, &inner.trees));
            removed.bytes = freed.sum();
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
        // Opening the folder collects orphans, and adding a description evicts others.
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

/// Removes the records of up to `batch` ended jobs, and subtracts them from the count of ended jobs.
fn remove_batch(
    trees: &Trees,
    keep: JobRetention,
    ended: &AtomicUsize,
    batch: usize,
) -> Result<RemovedBatch, StoreError> {
    let mut removed = RemovedBatch::default();
    for key in trees.ended.iter().keys().take(batch) {
        let key = key.map_err(failed)?;
        let Some((at, id)) = ended_job(&key) else {
            return Err(StoreError::Damaged("the key of an ended job cannot be read".into()));
        };
        let remaining = ended.load(Ordering::Relaxed);
        let count = match (keep.since, keep.most) {
            _ if at > keep.settled => break,
            (Some(since), _) if at < since => &mut removed.removed.by_age,
            (_, Some(most)) if remaining > most => &mut removed.removed.by_count,
            _ => break,
        };
        *count += 1;
        let record = trees.job(id)?;
        let frame = record.map(|record| {
            let reference = blob_ref_key(&record.query.digest, &BlobOwner::Query(record.query.id));
            (record.query.digest, reference)
        });
        (&trees.jobs, &trees.ended, &trees.blob_refs)
            .transaction(|(jobs, keys, refs)| {
                jobs.remove(id.as_bytes())?;
                keys.remove(&key)?;
                if let Some((_, reference)) = &frame {
                    refs.remove(reference.as_slice())?;
                }
                Ok(())
            })
            .map_err(transaction_failed)?;
        ended.fetch_sub(1, Ordering::Relaxed);
        removed.frames.extend(frame.map(|(digest, _)| digest));
    }
    Ok(removed)
}
