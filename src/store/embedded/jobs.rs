//! Jobs and their queue.
//!
//! A job that has not ended has an entry in the `queue` tree, whose value says until when nobody may
//! take it. Ids are UUIDs of version 7, so that key order is the order of submission.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use sled::Transactional;
use tokio::sync::broadcast;
use uuid::Uuid;

use super::super::changes::{ended_at, no_job, place, submitted_at};
use super::super::listing::SEARCHED;
use super::super::{
    Claim, IdempotencyRecord, JobFilter, JobList, JobRecord, JobStore, Release, Step, StoreError,
};
use super::trees::{
    BlobOwner, Lease, Trees, blob_ref_key, decode, encode, ended_key, failed, get, put, queue_key,
    queued_job, transaction_failed,
};
use super::webhooks::WebhookTrees;
use super::{EmbeddedStore, answers, blocking};
use whereabouts_core::{Job, Priority};

impl EmbeddedStore {
    /// Applies a change to one job and tells the listeners.
    async fn change<F>(&self, id: Uuid, change: F) -> Result<Job, StoreError>
    where
        F: FnOnce(&Trees, JobRecord) -> Result<JobRecord, StoreError> + Send + 'static,
    {
        let inner = Arc::clone(&self.inner);
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    let record = trees.job(id)?.ok_or_else(|| no_job(id))?;
                    let (before, record) = (record.job.state, change(trees, record)?);
                    Ok((before, record.job))
                },
                move |(before, job)| {
                    match (before.is_final(), job.state.is_final()) {
                        (false, true) => {
                            inner.queued.fetch_sub(1, Ordering::Relaxed);
                            inner.ended.fetch_add(1, Ordering::Relaxed);
                            inner.deliveries.send_replace(());
                        }
                        (true, false) => {
                            inner.queued.fetch_add(1, Ordering::Relaxed);
                            inner.ended.fetch_sub(1, Ordering::Relaxed);
                        }
                        _ => {}
                    }
                    let _ = inner.changes.send(id);
                },
            )
            .await
            .map(|(_, job)| job)
    }
}

impl EmbeddedStore {
    /// Queues a job, unless one was queued for the same request.
    async fn insert(
        &self,
        record: JobRecord,
        limit: usize,
        request: Option<String>,
    ) -> Result<Option<Job>, StoreError> {
        let (inner, id) = (Arc::clone(&self.inner), record.job.id);
        let counting = Arc::clone(&self.inner);
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    if let Some(request) = &request
                        && let Some(known) = queued_for(trees, request)?
                    {
                        return Ok(Some(known));
                    }
                    // Counted here, on the writer thread, so that no two submissions share the
                    // last place.
                    if counting.queued.fetch_add(1, Ordering::Relaxed) >= limit {
                        counting.queued.fetch_sub(1, Ordering::Relaxed);
                        return Err(StoreError::QueueFull { limit });
                    }
                    let noted = request.map_or(Ok(()), |request| note(trees, &request, id));
                    noted.and_then(|()| insert_job(trees, &record)).inspect_err(|_| {
                        counting.queued.fetch_sub(1, Ordering::Relaxed);
                    })?;
                    Ok(None)
                },
                move |known| {
                    if known.is_none() {
                        let _ = inner.changes.send(id);
                    }
                },
            )
            .await
    }
}

/// The job that was queued for a request.
fn queued_for(trees: &Trees, request: &str) -> Result<Option<Job>, StoreError> {
    let known: Option<IdempotencyRecord> = get(&trees.answers, request.as_bytes())?;
    let job = known.and_then(|known| known.job()).map(|id| trees.job(id)).transpose()?;
    Ok(job.flatten().map(|record| record.job))
}

/// Notes that a job is queued for a request. It is there only if the job is: whoever reads it looks.
fn note(trees: &Trees, request: &str, job: Uuid) -> Result<(), StoreError> {
    let known: Option<IdempotencyRecord> = get(&trees.answers, request.as_bytes())?;
    let Some(mut known) = known else { return Ok(()) };
    known.queued(job);
    answers::write(trees, request.as_bytes(), &known)
}

#[async_trait]
impl JobStore for EmbeddedStore {
    async fn submit(&self, record: JobRecord, limit: usize) -> Result<(), StoreError> {
        self.insert(record, limit, None).await.map(drop)
    }

    async fn submit_once(
        &self,
        record: JobRecord,
        limit: usize,
        request: &str,
    ) -> Result<Option<Job>, StoreError> {
        self.insert(record, limit, Some(request.to_owned())).await
    }

    async fn queued(&self) -> Result<usize, StoreError> {
        Ok(self.inner.queued.load(Ordering::Relaxed))
    }

    async fn oldest_unfinished(&self) -> Result<Option<Timestamp>, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || oldest_unfinished(&inner.trees)).await
    }

    async fn job(&self, id: Uuid) -> Result<Option<JobRecord>, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || inner.trees.job(id)).await
    }

    async fn jobs(
        &self,
        filter: &JobFilter,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<JobList, StoreError> {
        let (inner, filter) = (Arc::clone(&self.inner), filter.clone());
        blocking(move || {
            let most = filter.text.as_ref().map_or(usize::MAX, |_| SEARCHED);
            list(&inner.trees, &filter, before.unwrap_or(Uuid::max()), limit, most)
        })
        .await
    }

    async fn claim(
        &self,
        now: Timestamp,
        lease_until: Timestamp,
    ) -> Result<Option<JobRecord>, StoreError> {
        let inner = Arc::clone(&self.inner);
        // Looking costs no commit, and workers look every second.
        let looking = Arc::clone(&inner);
        if !blocking(move || some_may_be_taken(&looking.trees, now)).await? {
            return Ok(None);
        }
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    let Some(mut record) = next_waiting(trees, now)? else { return Ok(None) };
                    record.take(now);
                    write_job(trees, &record, Place::Queue(Some(lease_until)))?;
                    Ok(Some(record))
                },
                move |claimed: &Option<JobRecord>| {
                    if let Some(record) = claimed {
                        let _ = inner.changes.send(record.job.id);
                    }
                },
            )
            .await
    }

    async fn progress(&self, claim: Claim, step: Step) -> Result<(), StoreError> {
        self.change(claim.job, move |trees, mut record| {
            if record.is_held_by(claim) {
                record.add(step);
                put(&trees.jobs, claim.job.as_bytes(), &record)?;
            }
            Ok(record)
        })
        .await
        .map(drop)
    }

    async fn release(&self, claim: Claim, release: Release) -> Result<(), StoreError> {
        self.change(claim.job, move |trees, mut record| {
            if record.is_held_by(claim) {
                record.give_back(&release);
                write_job(trees, &record, Place::Queue(release.not_before))?;
            }
            Ok(record)
        })
        .await
        .map(drop)
    }

    async fn finish(&self, claim: Claim, job: Job) -> Result<(), StoreError> {
        self.change(claim.job, move |trees, mut record| {
            if record.is_held_by(claim) {
                record.job = job;
                write_job(trees, &record, Place::Ended(ended_at(&record.job)))?;
            }
            Ok(record)
        })
        .await
        .map(drop)
    }

    async fn cancel(&self, id: Uuid) -> Result<Job, StoreError> {
        self.change(id, move |trees, mut record| {
            if record.cancel(Timestamp::now()) {
                write_job(trees, &record, Place::Ended(ended_at(&record.job)))?;
            }
            Ok(record)
        })
        .await
    }

    async fn retry(&self, id: Uuid) -> Result<Job, StoreError> {
        self.change(id, move |trees, mut record| {
            let ended = ended_at(&record.job);
            record.queue_again()?;
            write_job(trees, &record, Place::Again { ended })?;
            Ok(record)
        })
        .await
    }

    fn changes(&self) -> broadcast::Receiver<Uuid> {
        self.inner.changes.subscribe()
    }
}

/// Jobs older than `before`, at most `limit` of them, among the `most` youngest of those.
fn list(
    trees: &Trees,
    filter: &JobFilter,
    before: Uuid,
    limit: usize,
    most: usize,
) -> Result<JobList, StoreError> {
    let (mut found, mut last) = (JobList::default(), None);
    for (looked, entry) in trees.jobs.range(..before.as_bytes().to_vec()).rev().enumerate() {
        if found.jobs.len() == limit {
            break;
        }
        if looked == most {
            found.searched_to = last;
            break;
        }
        let record: JobRecord = decode(&entry.map_err(failed)?.1)?;
        last = Some(record.job.id);
        if filter.matches(&record) {
            found.jobs.push(record.job);
        }
    }
    Ok(found)
}

/// No job is held or kept waiting longer than this, budgets of a day included. An entry that says so
/// was written before the clock was set back.
const LONGEST_LEASE: SignedDuration = SignedDuration::from_hours(25);

/// Whether an entry of the queue keeps its job from being taken.
fn is_held(lease: &[u8], now: Timestamp) -> Result<bool, StoreError> {
    let longest = now.saturating_add(LONGEST_LEASE).unwrap_or(Timestamp::MAX);
    Ok(decode::<Lease>(lease)?.is_some_and(|until| until > now && until <= longest))
}

fn some_may_be_taken(trees: &Trees, now: Timestamp) -> Result<bool, StoreError> {
    for lease in trees.queue.iter().values() {
        if !is_held(&lease.map_err(failed)?, now)? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The first job in the queue that may be taken.
fn next_waiting(trees: &Trees, now: Timestamp) -> Result<Option<JobRecord>, StoreError> {
    for entry in trees.queue.iter() {
        let (key, lease) = entry.map_err(failed)?;
        if is_held(&lease, now)? {
            continue;
        }
        match queued_job(&key).map(|id| trees.job(id)).transpose()?.flatten() {
            Some(record) => return Ok(Some(record)),
            None => {
                trees.queue.remove(key).map_err(failed)?;
            }
        }
    }
    Ok(None)
}

/// When the oldest job in the queue was submitted: the first of one of the priorities.
fn oldest_unfinished(trees: &Trees) -> Result<Option<Timestamp>, StoreError> {
    let mut oldest: Option<Uuid> = None;
    for priority in [Priority::High, Priority::Normal, Priority::Low] {
        if let Some(key) = trees.queue.scan_prefix([place(priority)]).keys().next() {
            let id = queued_job(&key.map_err(failed)?);
            oldest = oldest.into_iter().chain(id).min();
        }
    }
    Ok(oldest.and_then(submitted_at))
}

fn insert_job(trees: &Trees, record: &JobRecord) -> Result<(), StoreError> {
    let reference = blob_ref_key(&record.query.digest, &BlobOwner::Query(record.query.id));
    put(&trees.blob_refs, &reference, &())?;
    write_job(trees, record, Place::Queue(None))
}

/// Where a job is listed.
enum Place {
    /// In the queue.
    Queue(Lease),
    /// In the queue again, after it had ended.
    Again { ended: Timestamp },
    /// Among those that have ended, by when that was.
    Ended(Timestamp),
}

/// Writes a job and its place; and with its end, what webhooks are told of that.
fn write_job(trees: &Trees, record: &JobRecord, place: Place) -> Result<(), StoreError> {
    let (key, in_queue) = (record.job.id.as_bytes(), queue_key(&record.job));
    let value = encode(record)?;
    let (lease, gone, end) = match place {
        Place::Queue(lease) => (Some(encode(&lease)?), None, None),
        Place::Again { ended } => (Some(encode(&Lease::None)?), Some(ended), None),
        Place::Ended(at) => (None, None, Some(at)),
    };
    let news = end.map(|_| trees.webhooks.news_of(&record.job)).transpose()?.unwrap_or_default();
    let WebhookTrees { deliveries, bodies, due, .. } = &trees.webhooks;
    (&trees.jobs, &trees.queue, &trees.ended, deliveries, bodies, due)
        .transaction(|(jobs, queue, ended, deliveries, bodies, due)| {
            jobs.insert(key, value.as_slice())?;
            match &lease {
                Some(lease) => queue.insert(&in_queue, lease.as_slice())?,
                None => queue.remove(&in_queue)?,
            };
            if let Some(at) = gone {
                ended.remove(&ended_key(at, record.job.id))?;
            }
            if let Some(at) = end {
                ended.insert(&ended_key(at, record.job.id), &[] as &[u8])?;
            }
            news.iter().try_for_each(|news| news.write(deliveries, bodies, due))
        })
        .map_err(transaction_failed)
}

#[cfg(test)]
mod tests {
    use super::super::drafts::tests::settings;
    use super::*;
    use crate::Query;
    use whereabouts_core::{Digest, MapName, MediaType, RefinerKind};

    /// A job that waits in a map.
    async fn submitted(store: &EmbeddedStore, map: &str) -> Uuid {
        let (now, id) = (Timestamp::now(), Uuid::now_v7());
        let digest = Digest::of(id.as_bytes());
        let query =
            Query { id, digest, media_type: MediaType::Jpeg, created_at: now, descriptor: None };
        let map: MapName = map.parse().unwrap();
        let job = Job::queued(map, id, RefinerKind::Local, now);
        let id = job.id;
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
        store.submit(record, 100).await.unwrap();
        id
    }

    #[tokio::test]
    async fn a_search_ends_after_so_many_jobs_and_goes_on_where_it_ended() {
        let dir = tempfile::tempdir().unwrap();
        let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
        let mut jobs = Vec::new();
        for map in ["town", "yard", "town", "yard", "yard"] {
            jobs.push(submitted(&store, map).await);
        }
        let filter = JobFilter { text: Some("TOW".into()), ..JobFilter::default() };
        let search = |before: Uuid, limit: usize| {
            let found = list(&store.inner.trees, &filter, before, limit, 2).unwrap();
            (found.jobs.iter().map(|job| job.id).collect::<Vec<_>>(), found.searched_to)
        };
        assert_eq!(search(Uuid::max(), 10), (vec![], Some(jobs[3])));
        assert_eq!(search(jobs[3], 10), (vec![jobs[2]], Some(jobs[1])));
        assert_eq!(search(jobs[1], 10), (vec![jobs[0]], None));
        // A list that is full says nothing of where the search ended.
        assert_eq!(search(jobs[3], 1), (vec![jobs[2]], None));
        let whole = store.jobs(&filter, None, 10).await.unwrap();
        assert_eq!((whole.jobs.len(), whole.searched_to), (2, None));
    }

    #[test]
    fn a_lease_from_before_the_clock_was_set_back_holds_nothing() {
        let now: Timestamp = "2026-05-04T12:00:00Z".parse().unwrap();
        let held = |until: Option<&str>| {
            let lease: Lease = until.map(|until| until.parse().unwrap());
            is_held(&encode(&lease).unwrap(), now).unwrap()
        };
        assert!(held(Some("2026-05-04T12:00:01Z")) && held(Some("2026-05-05T00:00:00Z")));
        assert!(!held(None) && !held(Some("2026-05-04T11:59:59Z")));
        assert!(!held(Some("2027-05-04T12:00:00Z")));
    }
}
