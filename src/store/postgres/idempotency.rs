//! Idempotency records.

use async_trait::async_trait;
use jiff::Timestamp;
use jiff_sqlx::ToSqlx;
use sqlx::types::Json;

use super::super::{IdempotencyRecord, IdempotencyStore, Progress, StoreError};
use super::{PostgresStore, count, record, unavailable};

#[async_trait]
impl IdempotencyStore for PostgresStore {
    async fn reserve_request(
        &self,
        id: &str,
        reserved: IdempotencyRecord,
        since: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let insert = sqlx::query(
                    "INSERT INTO answers (id, at, holder, record) VALUES ($1, $2, $3, $4::json)
                     ON CONFLICT DO NOTHING",
                );
                let inserted = insert
                    .bind(id)
                    .bind(reserved.at.to_sqlx())
                    .bind(inner.process)
                    .bind(record(&reserved)?)
                    .execute(&mut *tx)
                    .await?;
                if inserted.rows_affected() > 0 {
                    tx.commit().await?;
                    return Ok(None);
                }
                let known = sqlx::query_as(
                    "SELECT record, CASE WHEN holder IS NULL THEN at >= $2
                         ELSE holder = $4 OR is_alive(holder, make_interval(secs => $3)) END
                     FROM answers WHERE id = $1 FOR UPDATE",
                );
                let known: Option<(Json<IdempotencyRecord>, bool)> = known
                    .bind(id)
                    .bind(since.to_sqlx())
                    .bind(inner.lifetime())
                    .bind(inner.process)
                    .fetch_optional(&mut *tx)
                    .await?;
                let Some((Json(known), counts)) = known else {
                    return Err(unavailable("the record of the request was just deleted"));
                };
                if counts {
                    return Ok(Some(known));
                }
                let reserved = reserved.replacing(&known);
                let replace = sqlx::query(
                    "UPDATE answers SET at = $2, holder = $3, record = $4::json WHERE id = $1",
                );
                replace
                    .bind(id)
                    .bind(reserved.at.to_sqlx())
                    .bind(inner.process)
                    .bind(record(&reserved)?)
                    .execute(&mut *tx)
                    .await?;
                tx.commit().await?;
                Ok(None)
            })
            .await
    }

    async fn store_response(&self, id: &str, answer: IdempotencyRecord) -> Result<(), StoreError> {
        let inner = &self.inner;
        let holder = matches!(answer.progress, Progress::Running { .. }).then_some(inner.process);
        let query = sqlx::query(
            "INSERT INTO answers (id, at, holder, record) VALUES ($1, $2, $3, $4::json)
             ON CONFLICT (id) DO UPDATE
             SET at = EXCLUDED.at, holder = EXCLUDED.holder, record = EXCLUDED.record",
        )
        .bind(id)
        .bind(answer.at.to_sqlx())
        .bind(holder)
        .bind(record(&answer)?);
        inner.run(query).await.map(drop)
    }

    async fn forget_request(&self, id: &str) -> Result<(), StoreError> {
        let inner = &self.inner;
        let query = sqlx::query("DELETE FROM answers WHERE id = $1").bind(id);
        inner.run(query).await.map(drop)
    }

    async fn prune_responses(&self, before: Timestamp, most: usize) -> Result<usize, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query(
            "DELETE FROM answers WHERE at < $1 OR id IN (
                 SELECT id FROM answers ORDER BY at DESC, id DESC OFFSET $2)",
        )
        .bind(before.to_sqlx())
        .bind(count(most));
        Ok(usize::try_from(inner.run(query).await?).unwrap_or(usize::MAX))
    }
}
