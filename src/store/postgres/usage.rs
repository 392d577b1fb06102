//! Usage of external models, by day and map.

use async_trait::async_trait;
use jiff::civil::Date;
use jiff_sqlx::ToSqlx;
use sqlx::Row;
use sqlx::postgres::PgRow;

use super::super::{StoreError, UsageStore};
use super::PostgresStore;
use whereabouts_core::{DayUsage, Usage};

#[async_trait]
impl UsageStore for PostgresStore {
    async fn add_usage(&self, spent: DayUsage) -> Result<(), StoreError> {
        let inner = &self.inner;
        let DayUsage { date, map, usage, money } = spent;
        // Spending is subtracted from this process's reservations.
        let query = sqlx::query(
            "WITH settled AS (
                 UPDATE set_aside SET tokens = greatest(tokens - $5 - $6, 0),
                     money = greatest(money - $8, 0)
                 WHERE day = $1 AND holder = $9)
             INSERT INTO usage (day, map, calls, cached, prompt_tokens, completion_tokens, estimated,
                 money)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8)
             ON CONFLICT (day, map) DO UPDATE SET
                 calls = usage.calls + EXCLUDED.calls,
                 cached = usage.cached + EXCLUDED.cached,
                 prompt_tokens = usage.prompt_tokens + EXCLUDED.prompt_tokens,
                 completion_tokens = usage.completion_tokens + EXCLUDED.completion_tokens,
                 estimated = usage.estimated + EXCLUDED.estimated,
                 money = usage.money + EXCLUDED.money",
        )
        .bind(date.to_sqlx())
        .bind(map.as_str().to_owned())
        .bind(i64::from(usage.calls))
        .bind(i64::from(usage.cached))
        .bind(usage.prompt_tokens.cast_signed())
        .bind(usage.completion_tokens.cast_signed())
        .bind(i64::from(usage.estimated))
        .bind(money)
        .bind(inner.process);
        inner.run(query).await.map(drop)
    }

    async fn usage(&self, from: Date) -> Result<Vec<DayUsage>, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query("SELECT * FROM usage WHERE day >= $1 ORDER BY day, map");
        let query = query.bind(from.to_sqlx());
        inner.call(async { query.fetch_all(&inner.pool).await?.iter().map(day).collect() }).await
    }
}

fn day(row: &PgRow) -> Result<DayUsage, StoreError> {
    let number = |column: &str| row.try_get::<i64, _>(column).map(i64::unsigned_abs);
    let small = |column: &str| number(column).map(|n| u32::try_from(n).unwrap_or(u32::MAX));
    let map: String = row.try_get("map")?;
    let map = map.parse().map_err(|_| {
        StoreError::Damaged("a usage record has an invalid map name; restore a backup".into())
    })?;
    Ok(DayUsage {
        date: row.try_get::<jiff_sqlx::Date, _>("day")?.to_jiff(),
        map,
        usage: Usage {
            calls: small("calls")?,
            cached: small("cached")?,
            prompt_tokens: number("prompt_tokens")?,
            completion_tokens: number("completion_tokens")?,
            estimated: small("estimated")?,
        },
        money: row.try_get("money")?,
    })
}
