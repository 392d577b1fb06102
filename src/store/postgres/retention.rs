//! Retention. Every server removes expired records and skips rows that another one is removing.

use async_trait::async_trait;
use jiff::civil::Date;
use jiff_sqlx::ToSqlx;

use super::super::{JobRetention, RemovedJobs, Retention, StoreError};
use super::descriptors::SIZES;
use super::{Inner, PostgresStore, count, counted};
use whereabouts_core::MapName;

#[async_trait]
impl Retention for PostgresStore {
    async fn remove_ended(
        &self,
        keep: JobRetention,
        batch: usize,
    ) -> Result<RemovedJobs, StoreError> {
        let inner = &self.inner;
        let removed = inner.call(inner.remove_jobs(keep, batch)).await?;
        let bytes = inner.remove_unreferenced().await?;
        Ok(RemovedJobs { bytes, ..removed })
    }

    async fn forget_usage(&self, before: Date) -> Result<(), StoreError> {
        let inner = &self.inner;
        let usage = sqlx::query("DELETE FROM usage WHERE day < $1").bind(before.to_sqlx());
        let reservations = sqlx::query("DELETE FROM set_aside WHERE day < current_date - 2");
        inner.run(usage).await?;
        inner.run(reservations).await.map(drop)
    }

    async fn collect_garbage(&self) -> Result<(), StoreError> {
        self.inner.collect_orphans().await?;
        self.inner.evict_descriptions().await
    }

    async fn db_bytes(&self) -> Result<u64, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let size = "SELECT pg_database_size(current_database())";
                let size: i64 = sqlx::query_scalar(size).fetch_one(&inner.pool).await?;
                Ok(size.unsigned_abs())
            })
            .await
    }

    async fn index_bytes(&self) -> Result<Vec<(MapName, u64)>, StoreError> {
        let inner = &self.inner;
        let sizes = sqlx::query_as(SIZES);
        let sizes: Vec<(String, i64)> =
            inner.call(async { Ok(sizes.fetch_all(&inner.pool).await?) }).await?;
        let sizes = sizes.into_iter();
        // Every name was valid when it was stored.
        Ok(sizes
            .filter_map(|(map, bytes)| Some((map.parse().ok()?, bytes.unsigned_abs())))
            .collect())
    }

    async fn free_bytes(&self) -> Option<u64> {
        // An object store does not report its free space.
        None
    }
}

impl Inner {
    /// Removes the rows of jobs that need not be kept, and their references to the bytes of their frames.
    async fn remove_jobs(
        &self,
        keep: JobRetention,
        batch: usize,
    ) -> Result<RemovedJobs, StoreError> {
        let ended = "SELECT count(*) FROM jobs WHERE ended_at IS NOT NULL";
        let ended: i64 = sqlx::query_scalar(ended).fetch_one(&self.pool).await?;
        let surplus = keep.most.map_or(0, |most| (ended - count(most)).max(0));
        let (by_age, by_count): (i64, i64) = sqlx::query_as(
            "WITH first AS (
                 SELECT id, digest, coalesce(ended_at < $1, false) AS old,
                     row_number() OVER (ORDER BY ended_at, id) <= $2 AS many
                 FROM (SELECT id, digest, ended_at FROM jobs
                       WHERE ended_at IS NOT NULL AND ended_at <= $3
                       ORDER BY ended_at, id LIMIT $4 FOR UPDATE SKIP LOCKED) locked),
             gone AS (
                 DELETE FROM jobs USING first WHERE jobs.id = first.id AND (old OR many)
                 RETURNING first.digest, first.old),
             needed AS (
                 UPDATE blobs b SET needed = b.needed - g.jobs
                 FROM (SELECT digest, count(*) AS jobs FROM gone GROUP BY digest) g
                 WHERE b.digest = g.digest)
             SELECT count(*) FILTER (WHERE old), count(*) FILTER (WHERE NOT old) FROM gone",
        )
        .bind(keep.since.map(|since| since.to_sqlx()))
        .bind(surplus)
        .bind(keep.settled.to_sqlx())
        .bind(count(batch))
        .fetch_one(&self.pool)
        .await?;
        Ok(RemovedJobs { by_age: counted(by_age), by_count: counted(by_count), bytes: 0 })
    }
}
