//! Ended jobs go, with their queries and frames: the first to end first, a few in each change, so that
//! no other change waits long.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use async_trait::async_trait;
use jiff::civil::Date;
use sled::Transactional;

use super::super::{KeepJobs, RemovedJobs, Retention, StoreError};
use super::trees::{BlobOwner, Trees, blob_ref_key, ended_job, failed, transaction_failed};
use super::{EmbeddedStore, blocking};
use crate::domain::Digest;

/// What one change took away.
#[derive(Default)]
struct Taken {
    removed: RemovedJobs,
    frames: Vec<Digest>,
}

#[async_trait]
impl Retention for EmbeddedStore {
    async fn remove_ended(&self, keep: KeepJobs, batch: usize) -> Result<RemovedJobs, StoreError> {
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

    async fn db_bytes(&self) -> Result<u64, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || inner.trees.bytes()).await
    }

    async fn free_bytes(&self) -> Option<u64> {
        let inner = Arc::clone(&self.inner);
        blocking(move || inner.blobs.free_bytes()).await.ok()
    }
}

/// Removes the records of up to `batch` of the jobs that have ended, and counts down.
fn take(
    trees: &Trees,
    keep: KeepJobs,
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

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use jiff::{SignedDuration, Timestamp};
    use uuid::Uuid;

    use super::super::drafts::tests::settings;
    use super::*;
    use crate::domain::{Job, JobState, MediaType, RefinerKind};
    use crate::store::{BlobStore, JobFilter, JobRecord, JobStore, Query};

    /// A job with a frame of its own, cancelled so many days ago unless it waits.
    async fn job(store: &EmbeddedStore, frame: &'static str, days_ago: Option<i64>) -> Uuid {
        let now = Timestamp::now();
        let (id, digest) = (Uuid::now_v7(), Digest::of(frame.as_bytes()));
        let query =
            Query { id, digest, media_type: MediaType::Jpeg, created_at: now, descriptor: None };
        let job = Job::queued("m".parse().unwrap(), id, RefinerKind::Local, now);
        let (map_uid, candidates) = (Uuid::nil(), vec![]);
        let record = JobRecord {
            job,
            map_uid,
            revision: 0,
            query,
            candidates,
            claims: 0,
            traceparent: None,
        };
        let id = record.job.id;
        let _pin = store.put_blob(digest, Bytes::from_static(frame.as_bytes())).await.unwrap();
        store.submit(record, 100).await.unwrap();
        if let Some(days) = days_ago {
            let claimed = store.claim(now, now).await.unwrap().unwrap();
            assert_eq!(claimed.job.id, id);
            let at = now - SignedDuration::from_hours(24 * days);
            let job = Job { state: JobState::Failed, finished_at: Some(at), ..claimed.job.clone() };
            store.finish(claimed.claim(), job).await.unwrap();
        }
        id
    }

    fn keep(days: i64, most: usize) -> KeepJobs {
        let now = Timestamp::now();
        let since = now - SignedDuration::from_hours(24 * days);
        KeepJobs { since: Some(since), most: Some(most), settled: now }
    }

    async fn has(store: &EmbeddedStore, frame: &str) -> bool {
        store.blob(&Digest::of(frame.as_bytes())).await.unwrap().is_some()
    }

    async fn listed(store: &EmbeddedStore, before: Option<Uuid>) -> Vec<Uuid> {
        let list = store.jobs(&JobFilter::default(), before, 10).await.unwrap();
        list.jobs.iter().map(|job| job.id).collect()
    }

    #[tokio::test]
    async fn old_jobs_go_with_frames_that_nothing_else_needs() {
        let dir = tempfile::tempdir().unwrap();
        let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
        let old = job(&store, "old", Some(40)).await;
        let shared = job(&store, "shared", Some(40)).await;
        let young = job(&store, "shared", Some(3)).await;
        let waiting = job(&store, "waiting", None).await;
        let removed = store.remove_ended(keep(30, 100), 64).await.unwrap();
        assert_eq!(removed, RemovedJobs { by_age: 2, by_count: 0, bytes: 3 });
        assert!(!has(&store, "old").await);
        assert!(has(&store, "shared").await && has(&store, "waiting").await);
        // A cursor may stand on a job that has gone.
        assert_eq!(listed(&store, None).await, [waiting, young]);
        assert!(listed(&store, Some(shared)).await.is_empty());
        assert_eq!(listed(&store, Some(waiting)).await, [young]);
        assert!(store.job(old).await.unwrap().is_none());
        assert!(store.retry(old).await.is_err());
        let again = store.remove_ended(keep(30, 100), 64).await.unwrap();
        assert_eq!(again, RemovedJobs::default());
    }

    #[tokio::test]
    async fn the_first_to_end_go_while_there_are_too_many_a_batch_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
        let mut jobs = Vec::new();
        for (frame, days) in [("a", 1), ("b", 5), ("c", 2), ("d", 4)] {
            jobs.push(job(&store, frame, Some(days)).await);
        }
        let batch = store.remove_ended(keep(30, 1), 2).await.unwrap();
        assert_eq!((batch.by_count, batch.by_age), (2, 0));
        assert_eq!(listed(&store, None).await, [jobs[2], jobs[0]]);
        assert_eq!(store.remove_ended(keep(30, 1), 2).await.unwrap().by_count, 1);
        assert_eq!(listed(&store, None).await, [jobs[0]]);
        // Whoever waits for it has not seen its end yet.
        let unsettled = KeepJobs { settled: Timestamp::UNIX_EPOCH, ..keep(0, 0) };
        assert_eq!(store.remove_ended(unsettled, 2).await.unwrap().jobs(), 0);
    }

    #[tokio::test]
    async fn a_job_that_is_retried_is_kept_until_it_has_ended_again() {
        let dir = tempfile::tempdir().unwrap();
        let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
        let id = job(&store, "a", Some(40)).await;
        store.retry(id).await.unwrap();
        assert_eq!(store.remove_ended(keep(30, 0), 8).await.unwrap().jobs(), 0);
        store.cancel(id).await.unwrap();
        let removed = store.remove_ended(keep(30, 0), 8).await.unwrap();
        assert_eq!((removed.by_count, removed.bytes), (1, 1));
    }
}
