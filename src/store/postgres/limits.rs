//! Limits that all processes share.
//!
//! Token buckets are in an unlogged table, which does not wait for the disk. After a crash of the
//! database, all buckets are full.

use async_trait::async_trait;
use jiff::civil::Date;
use jiff_sqlx::ToSqlx;

use super::super::{SharedLimits, StoreError, TokenGrant, TokenRequest};
use super::PostgresStore;
use super::statements::advisory_lock;
use whereabouts_core::Spent;

/// The advisory lock of calls that reserve a part of the budget.
const BUDGET_LOCK: i64 = 0x7768_6572_6561_0003;

#[async_trait]
impl SharedLimits for PostgresStore {
    async fn take_tokens(
        &self,
        name: &str,
        draws: [TokenRequest; 2],
    ) -> Result<TokenGrant, StoreError> {
        let inner = &self.inner;
        let [first, second] = draws;
        let query = sqlx::query_as(
            "INSERT INTO buckets AS b (name, first, second, at, taken)
             VALUES ($1, $2 - $4, $5 - $7, clock_timestamp(), true)
             ON CONFLICT (name) DO UPDATE SET (first, second, at, taken) = (
                 SELECT CASE WHEN enough THEN first - $4 ELSE first END,
                     CASE WHEN enough THEN second - $7 ELSE second END, now, enough
                 FROM (SELECT first, second, now,
                           first + 1e-3 > $3 AND second + 1e-3 > $6 AS enough
                       FROM (SELECT now, least(b.first + minutes * $2, $2) AS first,
                                 least(b.second + minutes * $5, $5) AS second
                             FROM (SELECT now, extract(epoch FROM now - b.at) / 60 AS minutes
                                   FROM clock_timestamp() now) passed) filled) compared)
             RETURNING taken, first, second",
        )
        .bind(name)
        .bind(first.per_minute)
        .bind(first.required)
        .bind(first.amount)
        .bind(second.per_minute)
        .bind(second.required)
        .bind(second.amount);
        inner
            .call(async {
                let (granted, first, second): (bool, f64, f64) =
                    query.fetch_one(&inner.pool).await?;
                Ok(TokenGrant { granted, remaining: [first, second] })
            })
            .await
    }

    async fn reserve(&self, day: Date, most: Spent, limit: Spent) -> Result<bool, StoreError> {
        let inner = &self.inner;
        let set = sqlx::query(
            "INSERT INTO set_aside AS a (day, holder, tokens, money)
             SELECT $1, $2, $3, $4 FROM (
                 SELECT coalesce(sum(tokens), 0) AS tokens, coalesce(sum(money), 0) AS money FROM (
                     SELECT prompt_tokens + completion_tokens AS tokens, money FROM usage
                     WHERE day = $1
                     UNION ALL
                     SELECT tokens, money FROM set_aside
                     WHERE day = $1 AND (holder = $2
                         OR is_alive(holder, make_interval(secs => $7)))) used) used
             WHERE ($5 = 0 OR tokens + $3 <= $5) AND ($6 = 0 OR money + $4 <= $6)
             ON CONFLICT (day, holder) DO UPDATE
             SET tokens = a.tokens + EXCLUDED.tokens, money = a.money + EXCLUDED.money",
        )
        .bind(day.to_sqlx())
        .bind(inner.process)
        .bind(most.tokens.cast_signed())
        .bind(most.money)
        .bind(limit.tokens.cast_signed())
        .bind(limit.money)
        .bind(inner.lifetime());
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                // One at a time, so that no two reservations use the same remainder.
                advisory_lock(&mut tx, BUDGET_LOCK).await?;
                let set = set.execute(&mut *tx).await?.rows_affected() > 0;
                tx.commit().await?;
                Ok(set)
            })
            .await
    }

    async fn release(&self, day: Date, unneeded: Spent) -> Result<(), StoreError> {
        let inner = &self.inner;
        let query = sqlx::query(
            "UPDATE set_aside SET tokens = greatest(tokens - $3, 0), money = greatest(money - $4, 0)
             WHERE day = $1 AND holder = $2",
        )
        .bind(day.to_sqlx())
        .bind(inner.process)
        .bind(unneeded.tokens.cast_signed())
        .bind(unneeded.money);
        inner.run(query).await.map(drop)
    }
}
