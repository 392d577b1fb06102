//! Calls that consist of a single statement.

use serde::de::DeserializeOwned;
use sqlx::postgres::{PgArguments, PgConnection};
use sqlx::query::{Query, QueryScalar};
use sqlx::types::Json;
use sqlx::{Postgres, Transaction};

use super::super::StoreError;
use super::Inner;

/// A statement that returns records.
type Records<'q, T> = QueryScalar<'q, Postgres, Json<T>, PgArguments>;

impl Inner {
    /// Runs a statement and returns the number of affected rows.
    pub(super) async fn run(
        &self,
        statement: Query<'_, Postgres, PgArguments>,
    ) -> Result<u64, StoreError> {
        self.call(async { Ok(statement.execute(&self.pool).await?.rows_affected()) }).await
    }

    /// Returns the record that a statement selects, if there is one.
    pub(super) async fn one<T>(&self, statement: Records<'_, T>) -> Result<Option<T>, StoreError>
    where
        T: DeserializeOwned + Send + Unpin + 'static,
    {
        let found = self.call(async { Ok(statement.fetch_optional(&self.pool).await?) }).await?;
        Ok(found.map(|Json(record)| record))
    }

    /// Returns all records that a statement selects.
    pub(super) async fn all<T>(&self, statement: Records<'_, T>) -> Result<Vec<T>, StoreError>
    where
        T: DeserializeOwned + Send + Unpin + 'static,
    {
        let found = self.call(async { Ok(statement.fetch_all(&self.pool).await?) }).await?;
        Ok(found.into_iter().map(|Json(record)| record).collect())
    }
}

/// Acquires an advisory lock, which is held until the end of the transaction.
pub(super) async fn advisory_lock(
    tx: &mut Transaction<'_, Postgres>,
    lock: i64,
) -> Result<(), StoreError> {
    let connection: &mut PgConnection = tx;
    sqlx::query("SELECT pg_advisory_xact_lock($1)").bind(lock).execute(connection).await?;
    Ok(())
}
