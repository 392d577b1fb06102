//! The schema's steps, which are in `migrations/`.

use std::borrow::Cow;

use sqlx::migrate::{AppliedMigration, Migrate, MigrateError, Migration, MigrationType, Migrator};
use sqlx::{PgPool, SqlSafeStr};

use super::super::StoreError;
use super::{PostgresSettings, RecentTimeout, connect};

/// How far the schema of a database is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SchemaState {
    /// It is what this program needs.
    UpToDate,
    /// Steps are missing.
    Behind {
        /// How many.
        steps: usize,
    },
    /// A program has been there that is later by more than one version.
    Ahead {
        /// Its steps go up to this one.
        version: i64,
    },
}

fn steps() -> Vec<Migration> {
    let step = |version, name: &'static str, sql: &'static str| {
        let sql = sql.into_sql_str();
        Migration::new(version, Cow::Borrowed(name), MigrationType::Simple, sql, false)
    };
    vec![step(1, "first", include_str!("../../../migrations/0001_first.sql"))]
}

/// Applies the missing steps; returns how many there were. Processes that do so at once wait for each other.
pub async fn migrate(settings: &PostgresSettings) -> Result<usize, StoreError> {
    let unhurried = PostgresSettings { max_connections: 1, ..settings.clone() };
    let pool = connect(&unhurried, &RecentTimeout::default())?;
    let missing = match schema_state(&pool).await? {
        SchemaState::UpToDate => 0,
        SchemaState::Behind { steps } => steps,
        SchemaState::Ahead { version } => return Err(too_new(version)),
    };
    if missing > 0 {
        let mut connection = pool.acquire().await?;
        // A step may take as long as it needs.
        sqlx::query("SET statement_timeout = 0").execute(&mut *connection).await?;
        Migrator::with_migrations(steps()).run(&mut *connection).await.map_err(failed)?;
    }
    pool.close().await;
    Ok(missing)
}

/// How far the schema of the database of these settings is.
pub async fn schema_of(settings: &PostgresSettings) -> Result<SchemaState, StoreError> {
    schema_state(&connect(settings, &RecentTimeout::default())?).await
}

/// How far the schema is.
pub(super) async fn schema_state(pool: &PgPool) -> Result<SchemaState, StoreError> {
    let known = steps();
    let mut connection = pool.acquire().await?;
    let there = "SELECT to_regclass('_sqlx_migrations') IS NOT NULL";
    if !sqlx::query_scalar::<_, bool>(there).fetch_one(&mut *connection).await? {
        return Ok(SchemaState::Behind { steps: known.len() });
    }
    let applied = connection.list_applied_migrations("_sqlx_migrations").await.map_err(failed)?;
    let is_known =
        |applied: &AppliedMigration| known.iter().any(|step| step.version == applied.version);
    let later: Vec<_> = applied.iter().filter(|applied| !is_known(applied)).collect();
    match (known.len() - (applied.len() - later.len()), later.as_slice()) {
        (0, []) => Ok(SchemaState::UpToDate),
        // Each step keeps the schema readable to the program before it.
        (0, [step]) => {
            tracing::warn!(step = step.version, "a later whereabouts has migrated the database");
            Ok(SchemaState::UpToDate)
        }
        (_, [.., last]) => Ok(SchemaState::Ahead { version: last.version }),
        (steps, []) => Ok(SchemaState::Behind { steps }),
    }
}

/// Why a database is left alone that a later program has migrated, and what to do.
pub(super) fn too_new(version: i64) -> StoreError {
    StoreError::Conflict(format!(
        "the database has version {version} of the schema, and this program does not know it: a later \
         whereabouts has migrated it. Run that one"
    ))
}

fn failed(error: MigrateError) -> StoreError {
    match error {
        MigrateError::Execute(error) => error.into(),
        error => StoreError::Failed(format!(
            "the schema cannot be brought up to date: {error}; nothing of the step was kept"
        )),
    }
}
