//! First answers to requests that may be sent again.

use async_trait::async_trait;
use jiff::Timestamp;
use jiff_sqlx::ToSqlx;
use sqlx::types::Json;

use super::super::{AnswerStore, FirstAnswer, Progress, StoreError};
use super::{PostgresStore, count, record};

#[async_trait]
impl AnswerStore for PostgresStore {
    async fn reserve_answer(
        &self,
        id: &str,
        reserved: FirstAnswer,
        since: Timestamp,
    ) -> Result<Option<FirstAnswer>, StoreError> {
        let inner = &self.inner;
        let text = record(&reserved)?;
        inner
            .call(async {
                loop {
                    let taken = sqlx::query(
                        "INSERT INTO answers (id, at, holder, record) VALUES ($1, $2, $3, $4::json)
                         ON CONFLICT (id) DO UPDATE
                         SET at = EXCLUDED.at, holder = EXCLUDED.holder, record = EXCLUDED.record
                         WHERE CASE WHEN answers.holder IS NULL THEN answers.at < $5
                             ELSE answers.holder <> $3
                                 AND NOT is_alive(answers.holder, make_interval(secs => $6)) END",
                    )
                    .bind(id)
                    .bind(reserved.at.to_sqlx())
                    .bind(inner.process)
                    .bind(&text)
                    .bind(since.to_sqlx())
                    .bind(inner.lifetime())
                    .execute(&inner.pool)
                    .await?;
                    if taken.rows_affected() > 0 {
                        return Ok(None);
                    }
                    let known = sqlx::query_scalar("SELECT record FROM answers WHERE id = $1");
                    let known: Option<Json<FirstAnswer>> =
                        known.bind(id).fetch_optional(&inner.pool).await?;
                    // It may have been forgotten in between.
                    if let Some(Json(known)) = known {
                        return Ok(Some(known));
                    }
                }
            })
            .await
    }

    async fn keep_answer(&self, id: &str, answer: FirstAnswer) -> Result<(), StoreError> {
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
        inner
            .call(async {
                query.execute(&inner.pool).await?;
                Ok(())
            })
            .await
    }

    async fn forget_answer(&self, id: &str) -> Result<(), StoreError> {
        let inner = &self.inner;
        let query = sqlx::query("DELETE FROM answers WHERE id = $1").bind(id);
        inner
            .call(async {
                query.execute(&inner.pool).await?;
                Ok(())
            })
            .await
    }

    async fn forget_answers(&self, before: Timestamp, most: usize) -> Result<usize, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query(
            "DELETE FROM answers WHERE at < $1 OR id IN (
                 SELECT id FROM answers ORDER BY at DESC, id DESC OFFSET $2)",
        )
        .bind(before.to_sqlx())
        .bind(count(most));
        inner
            .call(async {
                let gone = query.execute(&inner.pool).await?.rows_affected();
                Ok(usize::try_from(gone).unwrap_or(usize::MAX))
            })
            .await
    }
}
