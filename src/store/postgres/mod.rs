//! The scale-out store, for many processes: records and descriptors are in PostgreSQL with pgvector,
//! pictures in an object store.
//!
//! Processes share no state except through the database. A job, draft or idempotent request that a
//! process holds is marked with the process's id, and becomes free when the heartbeats of that process
//! stop (`processes.rs`). No lock is held longer than a statement or a short transaction. The exception
//! is building an index, which may take minutes and holds an advisory lock that nothing waits for.
//!
//! Every call has a time limit. If the database is down, too slow or too busy, the call fails with
//! [`StoreError::Unavailable`], having taken effect completely or not at all.

mod blobs;
mod claims;
mod descriptions;
mod descriptors;
mod drafts;
mod idempotency;
mod images;
mod indexer;
mod jobs;
mod keys;
mod limits;
mod listener;
mod maps;
mod processes;
mod retention;
mod schema;
mod search;
mod statements;
mod texts;
mod tracks;
mod usage;
mod webhooks;

use std::future::Future;
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::SignedDuration;
use parking_lot::Mutex;
use serde::Serialize;
use sqlx::postgres::{PgConnectOptions, PgPool, PgPoolOptions};
use sqlx::{Connection, Postgres, Transaction};
use tokio::sync::{broadcast, watch};
use tokio_util::sync::{CancellationToken, DropGuard};
use uuid::Uuid;

use self::descriptions::KnownLevels;
pub use self::schema::{SchemaState, migrate, schema_of};
use self::schema::{schema_state, too_new};
use super::{DescriptionBounds, Objects, StoreError};
use whereabouts_index::IndexSettings;

/// Settings of the store in PostgreSQL.
#[derive(Debug, Clone)]
pub struct PostgresSettings {
    /// `postgres://user:password@host:port/database`.
    pub url: String,
    /// Maximum number of connections of this process.
    pub max_connections: u32,
    /// Time limit of a call.
    pub timeout: Duration,
    /// A process without a heartbeat for this long is considered dead.
    pub lifetime: Duration,
    /// New image bytes are kept for at least this long, even without a reference.
    pub pin: Duration,
    /// How maps are indexed.
    pub index: IndexSettings,
    /// Memory for building an index, in MiB.
    pub index_memory_mib: u32,
    /// Bounds of the cache of descriptions.
    pub descriptions: DescriptionBounds,
}

/// The store in PostgreSQL; clones share it.
#[derive(Clone)]
pub struct PostgresStore {
    inner: Arc<Inner>,
}

struct Inner {
    pool: PgPool,
    recent_timeout: RecentTimeout,
    objects: Objects,
    settings: PostgresSettings,
    /// The id of this process.
    process: Uuid,
    changes: broadcast::Sender<Uuid>,
    deliveries: watch::Sender<()>,
    keys: watch::Sender<()>,
    levels: KnownLevels,
    graphs: descriptors::KnownGraphs,
    claims: claims::LocalClaims,
    /// Cancels the background tasks when it is dropped.
    _background: DropGuard,
}

/// Capacity of the channel of job changes; a slower receiver misses the oldest.
const CHANGES_CAPACITY: usize = 1024;

/// Prepared statements cached on each connection. Each map has its own, because they name its table.
const STATEMENT_CACHE: usize = 256;

impl PostgresStore {
    /// Opens the store for the process with this id. The schema must be up to date ([`migrate`]).
    pub async fn open(
        settings: PostgresSettings,
        objects: Objects,
        process: Uuid,
    ) -> Result<Self, StoreError> {
        let recent_timeout = RecentTimeout::default();
        let pool = connect(&settings, &recent_timeout)?;
        check_schema(&pool, &settings).await?;
        let background = CancellationToken::new();
        let inner = Arc::new(Inner {
            objects,
            process,
            changes: broadcast::channel(CHANGES_CAPACITY).0,
            deliveries: watch::Sender::new(()),
            keys: watch::Sender::new(()),
            levels: KnownLevels::default(),
            graphs: descriptors::KnownGraphs::default(),
            claims: claims::LocalClaims::default(),
            _background: background.clone().drop_guard(),
            pool,
            recent_timeout,
            settings,
        });
        inner.heartbeat().await?;
        // Listen before the store is handed out, so that no change is missed.
        let listener = inner.call(listener::connect(&inner.pool)).await?;
        let weak = Arc::downgrade(&inner);
        tokio::spawn(processes::send_heartbeats(weak.clone(), background.clone()));
        tokio::spawn(listener::listen(listener, weak.clone(), background.clone()));
        tokio::spawn(indexer::keep_indexed(weak, background));
        Ok(Self { inner })
    }
}

impl Inner {
    /// Runs a call within its time limit.
    async fn call<T>(
        &self,
        work: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, StoreError> {
        let limit = self.settings.timeout;
        let mut work = std::pin::pin!(work);
        tokio::time::timeout(limit, work.as_mut()).await.unwrap_or_else(|_| {
            // Recorded before `work` is dropped, which returns its connection to the pool.
            self.recent_timeout.record();
            let limit = limit.as_millis();
            Err(unavailable(format!("it did not answer within {limit} ms (database.timeout_ms)")))
        })
    }

    async fn begin(&self) -> Result<Transaction<'static, Postgres>, StoreError> {
        Ok(self.pool.begin().await?)
    }

    /// How long a process is considered alive after a heartbeat, in seconds.
    fn lifetime(&self) -> f64 {
        self.settings.lifetime.as_secs_f64()
    }
}

/// Time of the last call timeout. After a timeout, connections are pinged with a time limit before they
/// return to the pool, because the pool's own ping would wait on a dead socket forever.
#[derive(Clone, Default)]
struct RecentTimeout(Arc<Mutex<Option<Instant>>>);

impl RecentTimeout {
    fn record(&self) {
        *self.0.lock() = Some(Instant::now());
    }

    /// Whether a call timed out within this duration, so that its connection may be returned now.
    fn is_within(&self, duration: Duration) -> bool {
        let timed_out_at = *self.0.lock();
        timed_out_at.is_some_and(|at| at.elapsed() < duration)
    }
}

/// Creates a pool that connects lazily.
fn connect(
    settings: &PostgresSettings,
    recent_timeout: &RecentTimeout,
) -> Result<PgPool, StoreError> {
    let options = PgConnectOptions::from_str(&settings.url).map_err(|error| {
        // The error text may contain the URL, and with it a password.
        let what = match error {
            sqlx::Error::Configuration(_) => "not a valid URL",
            _ => "it cannot be used",
        };
        StoreError::Failed(format!(
            "database.url: {what}; write postgres://user:password@host:5432/database"
        ))
    })?;
    let ef_search = settings.index.ef_search.to_string();
    // The server aborts statements whose caller has timed out.
    let timeout_ms = settings.timeout.as_millis().to_string();
    let options = options
        .application_name("whereabouts")
        .statement_cache_capacity(STATEMENT_CACHE)
        .options([
            ("hnsw.ef_search", ef_search.as_str()),
            // Removed images stay in the index until the next vacuum, so scans continue until there are
            // enough results. Results are sorted again afterwards, and strict order would drop late ones.
            ("hnsw.iterative_scan", "relaxed_order"),
            // JIT compilation takes longer than a search.
            ("jit", "off"),
            ("statement_timeout", timeout_ms.as_str()),
            ("idle_in_transaction_session_timeout", timeout_ms.as_str()),
        ]);
    let (recent_timeout, timeout) = (recent_timeout.clone(), settings.timeout);
    Ok(PgPoolOptions::new()
        .max_connections(settings.max_connections)
        .acquire_timeout(settings.timeout)
        .acquire_slow_threshold(settings.timeout)
        .after_release(move |connection, _| {
            let suspect = recent_timeout.is_within(2 * timeout);
            Box::pin(async move {
                if suspect {
                    let pong = tokio::time::timeout(timeout, connection.ping()).await;
                    pong.map_err(|_| sqlx::Error::PoolTimedOut)??;
                }
                Ok(true)
            })
        })
        .connect_lazy_with(options))
}

async fn check_schema(pool: &PgPool, settings: &PostgresSettings) -> Result<(), StoreError> {
    let state = tokio::time::timeout(settings.timeout, schema_state(pool));
    match state.await.map_err(|_| unavailable("it did not answer".to_owned()))?? {
        SchemaState::UpToDate => Ok(()),
        SchemaState::Behind { steps } => Err(StoreError::Conflict(format!(
            "the database schema is not up to date (missing migrations: {steps}); run `whereabouts \
             migrate` with the same settings first"
        ))),
        SchemaState::Ahead { version } => Err(too_new(version)),
    }
}

/// The database was unavailable; the call may be retried.
fn unavailable(why: impl std::fmt::Display) -> StoreError {
    StoreError::Unavailable(format!("the database is not available: {why}; try again in a moment"))
}

/// Classes of SQLSTATE codes (their first two characters) that are transient: connection failures,
/// serialization failures, insufficient resources, operator intervention, system errors.
const TRANSIENT_CLASSES: [&str; 5] = ["08", "40", "53", "57", "58"];

impl From<sqlx::Error> for StoreError {
    fn from(error: sqlx::Error) -> Self {
        match &error {
            sqlx::Error::Database(reported) => {
                let code = reported.code().unwrap_or_default();
                let class = code.get(..2).unwrap_or_default();
                // 55P03: a lock was not available; 25P02 and 25P03: the transaction is aborted or idle.
                if TRANSIENT_CLASSES.contains(&class)
                    || matches!(&*code, "55P03" | "25P02" | "25P03")
                {
                    return unavailable(reported.message());
                }
                Self::Failed(format!("the database: {} ({code})", reported.message()))
            }
            sqlx::Error::Io(_)
            | sqlx::Error::Tls(_)
            | sqlx::Error::PoolTimedOut
            | sqlx::Error::PoolClosed
            | sqlx::Error::WorkerCrashed
            | sqlx::Error::Protocol(_) => unavailable(error),
            sqlx::Error::ColumnDecode { .. } | sqlx::Error::Decode(_) => Self::Damaged(format!(
                "a record of the database cannot be read ({error}); restore a backup"
            )),
            _ => Self::Failed(format!("the database: {error}")),
        }
    }
}

/// Whether a table does not exist, such as that of the descriptors of a deleted or reindexed map.
fn is_missing_table(error: &sqlx::Error) -> bool {
    error.as_database_error().and_then(|error| error.code()).as_deref() == Some("42P01")
}

/// Whether a lock could not be acquired in time.
fn is_locked(error: &sqlx::Error) -> bool {
    error.as_database_error().and_then(|error| error.code()).as_deref() == Some("55P03")
}

/// Encodes a record for storage.
fn record<T: Serialize>(value: &T) -> Result<String, StoreError> {
    serde_json::to_string(value).map_err(|error| StoreError::Failed(error.to_string()))
}

/// Converts a duration to seconds. Only durations are sent to the database, not times, because the
/// clocks of processes differ and the database's clock is the one that counts.
fn seconds(duration: SignedDuration) -> f64 {
    duration.as_secs_f64()
}

/// Converts a count to a `bigint`.
fn count(number: usize) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

/// Converts a `bigint` to a count.
fn counted(number: i64) -> usize {
    usize::try_from(number).unwrap_or(0)
}
