//! Jobs and their queue.
//!
//! A worker takes a job in a transaction of its own, which passes over jobs that others are taking
//! (`SKIP LOCKED`), and holds it by a mark: its process, the number of the claim, and until when. A job
//! whose holder is dead is free at once.

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
use super::statements::alone;
use super::{Inner, PostgresStore, count, counted, record, seconds};
use whereabouts_core::{Job, JobState, StoredWebhook};

/// So close to its bound the length of the queue is counted by one submission after another; before that,
/// as many submissions at once may do no harm.
const SUBMITTED_AT_ONCE: usize = 256;

/// The advisory lock of those who count.
const QUEUE_LOCK: i64 = 0x7768_6572_6561_0001;

/// Jobs read at a time while a text is looked for.
const PAGE: usize = 250;

/// What a change does to a job's row, beside its record.
enum Place {
    /// It stays as it is.
    Same,
    /// In the queue; nobody takes it for so many seconds.
    Queue { for_s: f64 },
    /// Held by this process for so many seconds.
    Held { for_s: f64 },
    /// It has ended.
    Ended,
}

impl PostgresStore {
    /// Applies a change to one job, unless the change says `None`.
    async fn change<F>(&self, id: Uuid, change: F) -> Result<Job, StoreError>
    where
        F: FnOnce(&mut JobRecord) -> Result<Option<Place>, StoreError> + Send,
    {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let found = sqlx::query_scalar("SELECT record FROM jobs WHERE id = $1 FOR UPDATE");
                let found = found.bind(id).fetch_optional(&mut *tx).await?;
                let Json(mut known): Json<JobRecord> = found.ok_or_else(|| no_job(id))?;
                let mut lets_go = false;
                let changed = match change(&mut known) {
                    Ok(Some(place)) => {
                        lets_go = !matches!(place, Place::Same);
                        inner.write_job(&mut tx, &known, place).await
                    }
                    Ok(None) => Ok(()),
                    Err(refused) => Err(refused),
                };
                // Also where nothing has changed: whoever claims passes over a job that is locked.
                match changed {
                    Ok(()) => tx.commit().await?,
                    Err(_) => tx.rollback().await?,
                }
                if lets_go && changed.is_ok() {
                    inner.claims.let_go(known.claim());
                }
                changed.map(|()| known.job)
            })
            .await
    }
}

impl Inner {
    /// Writes a job that is there and tells of it; and with its end, what webhooks are told of that.
    async fn write_job(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        changed: &JobRecord,
        place: Place,
    ) -> Result<(), StoreError> {
        let job = &changed.job;
        let (same, for_s, held, end) = match place {
            Place::Same => (true, 0.0, false, None),
            Place::Queue { for_s } => (false, for_s, false, None),
            Place::Held { for_s } => (false, for_s, true, None),
            Place::Ended => (false, 0.0, false, Some(ended_at(job))),
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
        .bind(same)
        .bind(for_s)
        .bind(held)
        .bind(self.process)
        .bind(end.map(|at| at.to_sqlx()))
        .bind(JOBS)
        .execute(&mut **tx)
        .await?;
        if end.is_some() {
            self.queue_news(tx, job).await?;
        }
        Ok(())
    }

    async fn queue_news(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        job: &Job,
    ) -> Result<(), StoreError> {
        let webhooks: Vec<Json<StoredWebhook>> =
            sqlx::query_scalar("SELECT record FROM webhooks ORDER BY id FOR KEY SHARE")
                .fetch_all(&mut **tx)
                .await?;
        let news = deliveries_for(job, webhooks.into_iter().map(|Json(stored)| stored))?;
        for delivery in &news {
            self.insert_delivery(tx, delivery).await?;
        }
        if !news.is_empty() {
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
        if self.waiting(&mut **tx, limit).await? + SUBMITTED_AT_ONCE > limit {
            alone(tx, QUEUE_LOCK).await?;
            if self.waiting(&mut **tx, limit).await? >= limit {
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

    /// Jobs of a map and state that are older than another, newest first.
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

    /// Jobs that wait or run.
    async fn waiting<'a>(
        &self,
        executor: impl sqlx::PgExecutor<'a>,
        limit: usize,
    ) -> Result<usize, StoreError> {
        let waiting =
            "SELECT count(*) FROM (SELECT FROM jobs WHERE ended_at IS NULL LIMIT $1) open";
        Ok(counted(sqlx::query_scalar(waiting).bind(count(limit)).fetch_one(executor).await?))
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
                    let note = sqlx::query("UPDATE answers SET record = $2::json WHERE id = $1");
                    note.bind(request).bind(record(&known)?).execute(&mut *tx).await?;
                }
                inner.insert_job(&mut tx, &new, limit).await?;
                tx.commit().await?;
                Ok(None)
            })
            .await
    }

    async fn queued(&self) -> Result<usize, StoreError> {
        let inner = &self.inner;
        inner.call(inner.waiting(&inner.pool, usize::MAX)).await
    }

    async fn oldest_unfinished(&self) -> Result<Option<Timestamp>, StoreError> {
        let inner = &self.inner;
        // Those that are open first, which are few: by the order of ids alone one would pass all that have ended.
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
        // The text is looked for here, so that both stores find the same.
        let (mut found, mut before, mut looked) = (JobList::default(), before, 0);
        while found.jobs.len() < limit {
            if looked >= MAX_EXAMINED {
                found.searched_to = before;
                break;
            }
            let page = inner.older(filter, before, PAGE).await?;
            let whole = page.len() == PAGE;
            for known in page {
                if found.jobs.len() == limit {
                    break;
                }
                (before, looked) = (Some(known.job.id), looked + 1);
                if filter.matches(&known) {
                    found.jobs.push(known.job);
                }
            }
            if !whole {
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
                    // Another worker of this process may have taken it since the list was made.
                    if !(ours && inner.claims.has(known.job.id)) {
                        break (tx, known);
                    }
                    tx.rollback().await?;
                };
                known.start_attempt(now);
                inner.write_job(&mut tx, &known, Place::Held { for_s }).await?;
                // If the answer to the commit is lost, nobody knows of the claim, and the job is free.
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
                Place::Same
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
                Place::Queue { for_s }
            }))
        })
        .await
        .map(drop)
    }

    async fn finish(&self, claim: Claim, job: Job) -> Result<(), StoreError> {
        self.change(claim.job, move |known| {
            Ok(known.is_held_by(claim).then(|| {
                known.job = job;
                Place::Ended
            }))
        })
        .await
        .map(drop)
    }

    async fn cancel(&self, id: Uuid) -> Result<Job, StoreError> {
        self.change(id, |known| Ok(known.cancel(Timestamp::now()).then_some(Place::Ended))).await
    }

    async fn retry(&self, id: Uuid) -> Result<Job, StoreError> {
        self.change(id, |known| {
            known.retry()?;
            Ok(Some(Place::Queue { for_s: 0.0 }))
        })
        .await
    }

    fn changes(&self) -> broadcast::Receiver<Uuid> {
        self.inner.changes.subscribe()
    }
}
