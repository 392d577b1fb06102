//! What most calls come down to: one statement, within the time that a call has.

use serde::de::DeserializeOwned;
use sqlx::postgres::{PgArguments, PgConnection};
use sqlx::query::{Query, QueryScalar};
use sqlx::types::Json;
use sqlx::{Postgres, Transaction};

use super::super::StoreError;
use super::Inner;

/// A statement that gives records.
type Records<'q, T> = QueryScalar<'q, Postgres, Json<T>, PgArguments>;

impl Inner {
    /// Changes something; returns how many rows.
    pub(super) async fn run(
        &self,
        statement: Query<'_, Postgres, PgArguments>,
    ) -> Result<u64, StoreError> {
        self.call(async { Ok(statement.execute(&self.pool).await?.rows_affected()) }).await
    }

    /// The record that a statement gives, if there is one.
    pub(super) async fn one<T>(&self, statement: Records<'_, T>) -> Result<Option<T>, StoreError>
    where
        T: DeserializeOwned + Send + Unpin + 'static,
    {
        let found = self.call(async { Ok(statement.fetch_optional(&self.pool).await?) }).await?;
        Ok(found.map(|Json(record)| record))
    }

    /// All records that a statement gives.
    pub(super) async fn all<T>(&self, statement: Records<'_, T>) -> Result<Vec<T>, StoreError>
    where
        T: DeserializeOwned + Send + Unpin + 'static,
    {
        let found = self.call(async { Ok(statement.fetch_all(&self.pool).await?) }).await?;
        Ok(found.into_iter().map(|Json(record)| record).collect())
    }
}

/// Waits until no other transaction holds this advisory lock; this one holds it until its end.
pub(super) async fn alone(tx: &mut Transaction<'_, Postgres>, lock: i64) -> Result<(), StoreError> {
    let connection: &mut PgConnection = tx;
    sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(lock).execute(connection).await?;
    Ok(())
}
