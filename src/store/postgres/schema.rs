//! The schema, whose migrations are in `migrations/`. `migrations/README.md` has the rules for adding one.

use std::borrow::Cow;

use sqlx::migrate::{AppliedMigration, Migrate, MigrateError, Migration, MigrationType, Migrator};
use sqlx::{PgPool, SqlSafeStr};

use super::super::StoreError;
use super::{PostgresSettings, RecentTimeout, connect};

/// The state of a database's schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SchemaState {
    /// The schema is the one that this program needs.
    UpToDate,
    /// Migrations are missing.
    Behind {
        /// Number of missing migrations.
        steps: usize,
    },
    /// A program that is newer by more than one version has migrated the database.
    Ahead {
        /// The version of its last migration.
        version: i64,
    },
}

fn migrations() -> Vec<Migration> {
    let migration = |version, name: &'static str, sql: &'static str| {
        let sql = sql.into_sql_str();
        Migration::new(version, Cow::Borrowed(name), MigrationType::Simple, sql, false)
    };
    vec![
        migration(1, "first", include_str!("../../../migrations/0001_first.sql")),
        migration(2, "moved", include_str!("../../../migrations/0002_moved.sql")),
        migration(3, "twins", include_str!("../../../migrations/0003_twins.sql")),
        migration(4, "vocabularies", include_str!("../../../migrations/0004_vocabularies.sql")),
        migration(5, "tracks", include_str!("../../../migrations/0005_tracks.sql")),
        migration(6, "texts", include_str!("../../../migrations/0006_texts.sql")),
    ]
}

/// Applies the missing migrations and returns their number. Concurrent calls wait for each other.
pub async fn migrate(settings: &PostgresSettings) -> Result<usize, StoreError> {
    let single = PostgresSettings { max_connections: 1, ..settings.clone() };
    let pool = connect(&single, &RecentTimeout::default())?;
    let missing = match schema_state(&pool).await? {
        SchemaState::UpToDate => 0,
        SchemaState::Behind { steps } => steps,
        SchemaState::Ahead { version } => return Err(too_new(version)),
    };
    if missing > 0 {
        let mut connection = pool.acquire().await?;
        // Migrations have no time limit.
        sqlx::query("SET statement_timeout = 0").execute(&mut *connection).await?;
        Migrator::with_migrations(migrations()).run(&mut *connection).await.map_err(failed)?;
    }
    pool.close().await;
    Ok(missing)
}

/// Returns the state of the schema of the database with these settings.
pub async fn schema_of(settings: &PostgresSettings) -> Result<SchemaState, StoreError> {
    schema_state(&connect(settings, &RecentTimeout::default())?).await
}

/// Returns the state of the schema.
pub(super) async fn schema_state(pool: &PgPool) -> Result<SchemaState, StoreError> {
    let known = migrations();
    let mut connection = pool.acquire().await?;
    let exists = "SELECT to_regclass('_sqlx_migrations') IS NOT NULL";
    if !sqlx::query_scalar::<_, bool>(exists).fetch_one(&mut *connection).await? {
        return Ok(SchemaState::Behind { steps: known.len() });
    }
    let applied = connection.list_applied_migrations("_sqlx_migrations").await.map_err(failed)?;
    let is_known =
        |applied: &AppliedMigration| known.iter().any(|known| known.version == applied.version);
    let later: Vec<_> = applied.iter().filter(|applied| !is_known(applied)).collect();
    match (known.len() - (applied.len() - later.len()), later.as_slice()) {
        (0, []) => Ok(SchemaState::UpToDate),
        // Every migration keeps the schema compatible with the previous version of the program.
        (0, [next]) => {
            tracing::warn!(
                step = next.version,
                "a later release of whereabouts has migrated the database"
            );
            Ok(SchemaState::UpToDate)
        }
        (_, [.., last]) => Ok(SchemaState::Ahead { version: last.version }),
        (steps, []) => Ok(SchemaState::Behind { steps }),
    }
}

/// Explains why a database that a later release has migrated is refused, and what to do.
pub(super) fn too_new(version: i64) -> StoreError {
    StoreError::Conflict(format!(
        "the database schema has version {version}, which this program does not support: a later \
         release of whereabouts has migrated it. Run that release"
    ))
}

fn failed(error: MigrateError) -> StoreError {
    match error {
        MigrateError::Execute(error) => error.into(),
        error => StoreError::Failed(format!(
            "the schema cannot be migrated: {error}; the failed migration was rolled back"
        )),
    }
}
