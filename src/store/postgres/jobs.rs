//! Jobs and their queue.
//!
//! A worker claims a job in a transaction that skips jobs being claimed by others (`SKIP LOCKED`). The
//! row then holds the claim: the process, the number of the claim, and when it expires. A job whose
//! process is dead can be claimed at once.

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use jiff_sqlx::ToSqlx;
use sqlx::types::Json;
use sqlx::{Postgres, Transaction};
use tokio::sync::broadcast;
use uuid::Uuid;

use super::super::changes::{deliveries_for, ended_at, no_job, queue_rank, submitted_at};
use super::super::listing::MAX_EXAMINED;
use super::super::{
    Claim, IdempotencyRecord, JobFilter, JobList, JobRecord, JobStore, Release, Step, StoreError,
};
use super::listener::{DELIVERIES, JOBS};
use super::statements::advisory_lock;
use super::{Inner, PostgresStore, count, counted, record, seconds};
use whereabouts_core::{Job, JobState, StoredWebhook};

/// Within this distance of the queue's bound, submissions count the queue one at a time. Farther away,
/// this many concurrent submissions cannot exceed the bound.
const SERIAL_MARGIN: usize = 256;

/// The advisory lock of submissions that count the queue.
const QUEUE_LOCK: i64 = 0x7768_6572_6561_0001;

/// Jobs read at a time by a text search.
const SEARCH_PAGE: usize = 250;

/// How a change affects the columns of a job's row next to its record.
enum RowUpdate {
    /// Only the record changes.
    Keep,
    /// The job is queued, and cannot be claimed for a number of seconds.
    Queue { for_s: f64 },
    /// This process holds the job for a number of seconds.
    Hold { for_s: f64 },
    /// The job has ended.
    End,
}

impl PostgresStore {
    /// Applies a change to one job; a change that returns `None` writes nothing.
    async fn change<F>(&self, id: Uuid, change: F) -> Result<Job, StoreError>
    where
        F: FnOnce(&mut JobRecord) -> Result<Option<RowUpdate>, StoreError> + Send,
    {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let found = sqlx::query_scalar("SELECT record FROM jobs WHERE id = $1 FOR UPDATE");
                let found = found.bind(id).fetch_optional(&mut *tx).await?;
                let Json(mut known): Json<JobRecord> = found.ok_or_else(|| no_job(id))?;
                let mut releases = false;
                let changed = match change(&mut known) {
                    Ok(Some(update)) => {
                        releases = !matches!(update, RowUpdate::Keep);
                        inner.write_job(&mut tx, &known, update).await
                    }
                    Ok(None) => Ok(()),
                    Err(refused) => Err(refused),
                };
                // End the transaction even if nothing has changed, because claims skip a locked job.
                match changed {
                    Ok(()) => tx.commit().await?,
                    Err(_) => tx.rollback().await?,
                }
                if releases && changed.is_ok() {
                    inner.claims.release(known.claim());
                }
                changed.map(|()| known.job)
            })
            .await
    }
}

impl Inner {
    /// Updates a job and notifies other processes; if the job has ended, also queues the deliveries
    /// about its end.
    async fn write_job(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        changed: &JobRecord,
        update: RowUpdate,
    ) -> Result<(), StoreError> {
        let job = &changed.job;
        let (keep, for_s, held, end) = match update {
            RowUpdate::Keep => (true, 0.0, false, None),
            RowUpdate::Queue { for_s } => (false, for_s, false, None),
            RowUpdate::Hold { for_s } => (false, for_s, true, None),
            RowUpdate::End => (false, 0.0, false, Some(ended_at(job))),
        };
        sqlx::query(
            "WITH changed AS (
                 UPDATE jobs SET record = $2::json, state = $3, changed_at = now(),
                     held_until = CASE WHEN $4 THEN held_until
                         WHEN $5 > 0 THEN now() + make_interval(secs => $5) END,
                     holder = CASE WHEN $4 THEN holder WHEN $6 THEN $7 END,
                     ended_at = CASE WHEN $4 THEN ended_at ELSE $8 END
                 WHERE id = $1)
             SELECT pg_notify($9, $1::text)",
        )
        .bind(job.id)
        .bind(record(changed)?)
        .bind(job.state.as_str())
        .bind(keep)
        .bind(for_s)
        .bind(held)
        .bind(self.process)
        .bind(end.map(|at| at.to_sqlx()))
        .bind(JOBS)
        .execute(&mut **tx)
        .await?;
        if end.is_some() {
            self.queue_deliveries(tx, job).await?;
        }
        Ok(())
    }

    async fn queue_deliveries(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        job: &Job,
    ) -> Result<(), StoreError> {
        let webhooks: Vec<Json<StoredWebhook>> =
            sqlx::query_scalar("SELECT record FROM webhooks ORDER BY id FOR KEY SHARE")
                .fetch_all(&mut **tx)
                .await?;
        let outbox = deliveries_for(job, webhooks.into_iter().map(|Json(stored)| stored))?;
        for delivery in &outbox {
            self.insert_delivery(tx, delivery).await?;
        }
        if !outbox.is_empty() {
            sqlx::query("SELECT pg_notify($1, '')").bind(DELIVERIES).execute(&mut **tx).await?;
        }
        Ok(())
    }

    /// Queues a job, unless the queue is full.
    async fn insert_job(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        new: &JobRecord,
        limit: usize,
    ) -> Result<(), StoreError> {
        if self.unfinished(&mut **tx, limit).await? + SERIAL_MARGIN > limit {
            advisory_lock(tx, QUEUE_LOCK).await?;
            if self.unfinished(&mut **tx, limit).await? >= limit {
                return Err(StoreError::QueueFull { limit });
            }
        }
        let job = &new.job;
        let inserted = sqlx::query(
            "WITH needed AS (
                 UPDATE blobs SET needed = needed + 1 WHERE digest = $5 RETURNING digest),
             told AS (SELECT pg_notify($7, $1::text))
             INSERT INTO jobs (id, map, state, place, digest, record)
             SELECT $1, $2, $3, $4, digest, $6::json FROM needed, told",
        )
        .bind(job.id)
        .bind(job.map.as_str())
        .bind(job.state.as_str())
        .bind(i16::from(queue_rank(job.priority)))
        .bind(new.query.digest.as_bytes().as_slice())
        .bind(record(new)?)
        .bind(JOBS)
        .execute(&mut **tx)
        .await?;
        match inserted.rows_affected() {
            0 => Err(super::blobs::not_stored(&new.query.digest)),
            _ => Ok(()),
        }
    }

    /// Returns up to `limit` jobs of a map and state that are older than `before`, newest first.
    async fn older(
        &self,
        filter: &JobFilter,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<Vec<JobRecord>, StoreError> {
        let query = sqlx::query_scalar(
            "SELECT record FROM jobs
             WHERE id < $1 AND ($2::text IS NULL OR map = $2) AND ($3::text IS NULL OR state = $3)
             ORDER BY id DESC LIMIT $4",
        )
        .bind(before.unwrap_or(Uuid::max()))
        .bind(filter.map.as_ref().map(|map| map.as_str()))
        .bind(filter.state.map(JobState::as_str))
        .bind(count(limit));
        self.all(query).await
    }

    /// Counts the jobs that are queued or running, up to `limit`.
    async fn unfinished<'a>(
        &self,
        executor: impl sqlx::PgExecutor<'a>,
        limit: usize,
    ) -> Result<usize, StoreError> {
        let unfinished =
            "SELECT count(*) FROM (SELECT FROM jobs WHERE ended_at IS NULL LIMIT $1) open";
        Ok(counted(sqlx::query_scalar(unfinished).bind(count(limit)).fetch_one(executor).await?))
    }
}

#[async_trait]
impl JobStore for PostgresStore {
    async fn submit(&self, new: JobRecord, limit: usize) -> Result<(), StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                inner.insert_job(&mut tx, &new, limit).await?;
                Ok(tx.commit().await?)
            })
            .await
    }

    async fn submit_once(
        &self,
        new: JobRecord,
        limit: usize,
        request: &str,
    ) -> Result<Option<Job>, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let known =
                    sqlx::query_scalar("SELECT record FROM answers WHERE id = $1 FOR UPDATE");
                let known: Option<Json<IdempotencyRecord>> =
                    known.bind(request).fetch_optional(&mut *tx).await?;
                if let Some(Json(mut known)) = known {
                    let job = sqlx::query_scalar("SELECT record FROM jobs WHERE id = $1");
                    let job: Option<Json<JobRecord>> =
                        job.bind(known.job()).fetch_optional(&mut *tx).await?;
                    if let Some(Json(queued)) = job {
                        return Ok(Some(queued.job));
                    }
                    known.set_job(new.job.id);
                    let update = sqlx::query("UPDATE answers SET record = $2::json WHERE id = $1");
                    update.bind(request).bind(record(&known)?).execute(&mut *tx).await?;
                }
                inner.insert_job(&mut tx, &new, limit).await?;
                tx.commit().await?;
                Ok(None)
            })
            .await
    }

    async fn queued(&self) -> Result<usize, StoreError> {
        let inner = &self.inner;
        inner.call(inner.unfinished(&inner.pool, usize::MAX)).await
    }

    async fn oldest_unfinished(&self) -> Result<Option<Timestamp>, StoreError> {
        let inner = &self.inner;
        // Selects the few unfinished jobs first: a scan in order of id would pass over all ended jobs.
        let oldest = sqlx::query_scalar(
            "WITH open AS MATERIALIZED (SELECT id FROM jobs WHERE ended_at IS NULL)
             SELECT id FROM open ORDER BY id LIMIT 1",
        );
        let oldest: Option<Uuid> =
            inner.call(async { Ok(oldest.fetch_optional(&inner.pool).await?) }).await?;
        Ok(oldest.and_then(submitted_at))
    }

    async fn job(&self, id: Uuid) -> Result<Option<JobRecord>, StoreError> {
        self.inner.one(sqlx::query_scalar("SELECT record FROM jobs WHERE id = $1").bind(id)).await
    }

    async fn jobs(
        &self,
        filter: &JobFilter,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<JobList, StoreError> {
        let inner = &self.inner;
        if filter.text.is_none() {
            let page = inner.older(filter, before, limit).await?;
            let jobs = page.into_iter().map(|known| known.job).collect();
            return Ok(JobList { jobs, searched_to: None });
        }
        // The search runs here rather than in SQL, so that both stores match the same texts.
        let (mut found, mut before, mut examined) = (JobList::default(), before, 0);
        while found.jobs.len() < limit {
            if examined >= MAX_EXAMINED {
                found.searched_to = before;
                break;
            }
            let page = inner.older(filter, before, SEARCH_PAGE).await?;
            let is_full = page.len() == SEARCH_PAGE;
            for known in page {
                if found.jobs.len() == limit {
                    break;
                }
                (before, examined) = (Some(known.job.id), examined + 1);
                if filter.matches(&known) {
                    found.jobs.push(known.job);
                }
            }
            if !is_full {
                break;
            }
        }
        Ok(found)
    }

    async fn claim(
        &self,
        now: Timestamp,
        lease_until: Timestamp,
    ) -> Result<Option<JobRecord>, StoreError> {
        let inner = &self.inner;
        let for_s = seconds(lease_until.duration_since(now).max(SignedDuration::ZERO));
        inner
            .call(async {
                let (mut tx, mut known) = loop {
                    let mut tx = inner.begin().await?;
                    let found = sqlx::query_as(
                        "SELECT record, coalesce(holder = $1 AND held_until > now(), false) FROM jobs
                         WHERE ended_at IS NULL AND (held_until IS NULL OR held_until <= now()
                             OR CASE WHEN holder IS NULL THEN false
                                 WHEN holder = $1 THEN id <> ALL ($3)
                                 ELSE NOT is_alive(holder, make_interval(secs => $2)) END)
                         ORDER BY place, id LIMIT 1 FOR UPDATE SKIP LOCKED",
                    )
                    .bind(inner.process)
                    .bind(inner.lifetime())
                    .bind(inner.claims.all());
                    let found: Option<(Json<JobRecord>, bool)> =
                        found.fetch_optional(&mut *tx).await?;
                    let Some((Json(known), ours)) = found else { return Ok(None) };
                    // Another worker of this process may have claimed it since the list was made.
                    if !(ours && inner.claims.has(known.job.id)) {
                        break (tx, known);
                    }
                    tx.rollback().await?;
                };
                known.start_attempt(now);
                inner.write_job(&mut tx, &known, RowUpdate::Hold { for_s }).await?;
                // If the result of the commit is lost, the guard drops the claim and the job is free.
                let guard = inner.claims.hold(known.claim(), for_s);
                tx.commit().await?;
                guard.keep();
                Ok(Some(known))
            })
            .await
    }

    async fn progress(&self, claim: Claim, step: Step) -> Result<(), StoreError> {
        self.change(claim.job, move |known| {
            Ok(known.is_held_by(claim).then(|| {
                known.add(step);
                RowUpdate::Keep
            }))
        })
        .await
        .map(drop)
    }

    async fn release(&self, claim: Claim, release: Release) -> Result<(), StoreError> {
        let wait = release.not_before.map(|at| at.duration_since(Timestamp::now()));
        let for_s = wait.map_or(0.0, seconds).max(0.0);
        self.change(claim.job, move |known| {
            Ok(known.is_held_by(claim).then(|| {
                known.requeue(&release);
                RowUpdate::Queue { for_s }
            }))
        })
        .await
        .map(drop)
    }

    async fn finish(&self, claim: Claim, job: Job) -> Result<(), StoreError> {
        self.change(claim.job, move |known| {
            Ok(known.is_held_by(claim).then(|| {
                known.job = job;
                RowUpdate::End
            }))
        })
        .await
        .map(drop)
    }

    async fn cancel(&self, id: Uuid) -> Result<Job, StoreError> {
        self.change(id, |known| Ok(known.cancel(Timestamp::now()).then_some(RowUpdate::End))).await
    }

    async fn retry(&self, id: Uuid, fresh_since: Option<Timestamp>) -> Result<Job, StoreError> {
        self.change(id, |known| {
            known.retry(fresh_since)?;
            Ok(Some(RowUpdate::Queue { for_s: 0.0 }))
        })
        .await
    }

    fn changes(&self) -> broadcast::Receiver<Uuid> {
        self.inner.changes.subscribe()
    }
}
