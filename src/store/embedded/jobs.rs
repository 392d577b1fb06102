//! Jobs and their queue.
//!
//! A job that has not ended has an entry in the `queue` tree, whose value is the moment before which
//! the job cannot be claimed. Ids are version 7 UUIDs, so key order is the order of submission.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use sled::Transactional;
use tokio::sync::broadcast;
use uuid::Uuid;

use super::super::changes::{ended_at, no_job, queue_rank, submitted_at};
use super::super::listing::MAX_EXAMINED;
use super::super::{
    Claim, IdempotencyRecord, JobFilter, JobList, JobRecord, JobStore, Release, Step, StoreError,
};
use super::trees::{
    BlobOwner, Lease, Trees, blob_ref_key, decode, encode, ended_key, failed, get, put, queue_key,
    queued_job, transaction_failed,
};
use super::webhooks::trees::WebhookTrees;
use super::{EmbeddedStore, blocking, idempotency};
use whereabouts_core::{Job, Priority};

impl EmbeddedStore {
    /// Applies a change to one job and publishes it.
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
    /// Queues a job, unless one is already queued for the same request; then returns that one.
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
                    // Counted on the writer thread, so that two submissions cannot both take the last
                    // place.
                    if counting.queued.fetch_add(1, Ordering::Relaxed) >= limit {
                        counting.queued.fetch_sub(1, Ordering::Relaxed);
                        return Err(StoreError::QueueFull { limit });
                    }
                    let noted = request.map_or(Ok(()), |request| set_job(trees, &request, id));
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

/// Returns the job that was queued for a request.
fn queued_for(trees: &Trees, request: &str) -> Result<Option<Job>, StoreError> {
    let known: Option<IdempotencyRecord> = get(&trees.answers, request.as_bytes())?;
    let job = known.and_then(|known| known.job()).map(|id| trees.job(id)).transpose()?;
    Ok(job.flatten().map(|record| record.job))
}

/// Records the job that is about to be queued for a request. If the job is never written, the reference
/// dangles, and [`queued_for`] ignores it.
fn set_job(trees: &Trees, request: &str, job: Uuid) -> Result<(), StoreError> {
    let known: Option<IdempotencyRecord> = get(&trees.answers, request.as_bytes())?;
    let Some(mut known) = known else { return Ok(()) };
    known.set_job(job);
    idempotency::write(trees, request.as_bytes(), &known)
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
            let max_examined = filter.text.as_ref().map_or(usize::MAX, |_| MAX_EXAMINED);
            list(&inner.trees, &filter, before.unwrap_or(Uuid::max()), limit, max_examined)
        })
        .await
    }

    async fn claim(
        &self,
        now: Timestamp,
        lease_until: Timestamp,
    ) -> Result<Option<JobRecord>, StoreError> {
        let inner = Arc::clone(&self.inner);
        // Workers poll every second; a read costs no commit.
        let polling = Arc::clone(&inner);
        if !blocking(move || is_any_claimable(&polling.trees, now)).await? {
            return Ok(None);
        }
        self.inner
            .writer
            .commit(
                move |trees, _| {
                    let Some(mut record) = next_claimable(trees, now)? else { return Ok(None) };
                    record.start_attempt(now);
                    write_job(trees, &record, Listing::Queue(Some(lease_until)))?;
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
                record.requeue(&release);
                write_job(trees, &record, Listing::Queue(release.not_before))?;
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
                write_job(trees, &record, Listing::Ended(ended_at(&record.job)))?;
            }
            Ok(record)
        })
        .await
        .map(drop)
    }

    async fn cancel(&self, id: Uuid) -> Result<Job, StoreError> {
        self.change(id, move |trees, mut record| {
            if record.cancel(Timestamp::now()) {
                write_job(trees, &record, Listing::Ended(ended_at(&record.job)))?;
            }
            Ok(record)
        })
        .await
    }

    async fn retry(&self, id: Uuid, fresh_since: Option<Timestamp>) -> Result<Job, StoreError> {
        self.change(id, move |trees, mut record| {
            let ended = ended_at(&record.job);
            record.retry(fresh_since)?;
            write_job(trees, &record, Listing::Requeued { ended })?;
            Ok(record)
        })
        .await
    }

    fn changes(&self) -> broadcast::Receiver<Uuid> {
        self.inner.changes.subscribe()
    }
}

/// Returns up to `limit` matching jobs older than `before`, after examining at most `max_examined`.
fn list(
    trees: &Trees,
    filter: &JobFilter,
    before: Uuid,
    limit: usize,
    max_examined: usize,
) -> Result<JobList, StoreError> {
    let (mut found, mut last) = (JobList::default(), None);
    for (examined, entry) in trees.jobs.range(..before.as_bytes().to_vec()).rev().enumerate() {
        if found.jobs.len() == limit {
            break;
        }
        if examined == max_examined {
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

/// The longest possible lease or delay, waiting for a daily budget included. A longer one was written
/// before the clock was set back, and does not count.
const LONGEST_LEASE: SignedDuration = SignedDuration::from_hours(25);

/// Whether the lease of a queue entry keeps its job from being claimed.
fn is_held(lease: &[u8], now: Timestamp) -> Result<bool, StoreError> {
    let longest = now.saturating_add(LONGEST_LEASE).unwrap_or(Timestamp::MAX);
    Ok(decode::<Lease>(lease)?.is_some_and(|until| until > now && until <= longest))
}

fn is_any_claimable(trees: &Trees, now: Timestamp) -> Result<bool, StoreError> {
    for lease in trees.queue.iter().values() {
        if !is_held(&lease.map_err(failed)?, now)? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Returns the first job in the queue that can be claimed.
fn next_claimable(trees: &Trees, now: Timestamp) -> Result<Option<JobRecord>, StoreError> {
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

/// Returns when the oldest job in the queue was submitted, which is the first of some priority.
fn oldest_unfinished(trees: &Trees) -> Result<Option<Timestamp>, StoreError> {
    let mut oldest: Option<Uuid> = None;
    for priority in [Priority::High, Priority::Normal, Priority::Low] {
        if let Some(key) = trees.queue.scan_prefix([queue_rank(priority)]).keys().next() {
            let id = queued_job(&key.map_err(failed)?);
            oldest = oldest.into_iter().chain(id).min();
        }
    }
    Ok(oldest.and_then(submitted_at))
}

fn insert_job(trees: &Trees, record: &JobRecord) -> Result<(), StoreError> {
    let reference = blob_ref_key(&record.query.digest, &BlobOwner::Query(record.query.id));
    put(&trees.blob_refs, &reference, &())?;
    write_job(trees, record, Listing::Queue(None))
}

/// The tree that lists a job.
enum Listing {
    /// The queue.
    Queue(Lease),
    /// The queue, after the job had ended.
    Requeued { ended: Timestamp },
    /// The ended jobs, by their end time.
    Ended(Timestamp),
}

/// Writes a job and its listing, and the deliveries about its end if it has ended.
fn write_job(trees: &Trees, record: &JobRecord, listing: Listing) -> Result<(), StoreError> {
    let (key, in_queue) = (record.job.id.as_bytes(), queue_key(&record.job));
    let value = encode(record)?;
    let (lease, delisted, end) = match listing {
        Listing::Queue(lease) => (Some(encode(&lease)?), None, None),
        Listing::Requeued { ended } => (Some(encode(&Lease::None)?), Some(ended), None),
        Listing::Ended(at) => (None, None, Some(at)),
    };
    let outbox = end.map(|_| trees.webhooks.deliveries_for(&record.job)).transpose()?;
    let outbox = outbox.unwrap_or_default();
    let WebhookTrees { deliveries, bodies, due, .. } = &trees.webhooks;
    (&trees.jobs, &trees.queue, &trees.ended, deliveries, bodies, due)
        .transaction(|(jobs, queue, ended, deliveries, bodies, due)| {
            jobs.insert(key, value.as_slice())?;
            match &lease {
                Some(lease) => queue.insert(&in_queue, lease.as_slice())?,
                None => queue.remove(&in_queue)?,
            };
            if let Some(at) = delisted {
                ended.remove(&ended_key(at, record.job.id))?;
            }
            if let Some(at) = end {
                ended.insert(&ended_key(at, record.job.id), &[] as &[u8])?;
            }
            outbox.iter().try_for_each(|delivery| delivery.write(deliveries, bodies, due))
        })
        .map_err(transaction_failed)
}

#[cfg(test)]
mod tests;
