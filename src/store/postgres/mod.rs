//! The store of many processes: records and descriptors in PostgreSQL with pgvector, pictures in an object
//! store.
//!
//! Nothing is kept in a process that another would need. What a process holds for a while, a job, a draft, a
//! request that is to be done once, is marked with the process's id, and free again when the process has
//! not said for a while that it is alive (`processes`). No lock outlives its statement or its short
//! transaction; building an index, which may take minutes, holds an advisory lock that nobody waits for.
//!
//! Every call has a time limit. A database that is away, too slow or too busy is
//! [`StoreError::Unavailable`], and nothing of the call has happened, or all of it.

mod answers;
mod blobs;
mod descriptions;
mod descriptors;
mod drafts;
mod held;
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
mod statements;
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

/// How the store in PostgreSQL works.
#[derive(Debug, Clone)]
pub struct PostgresSettings {
    /// `postgres://user:password@host:port/database`.
    pub url: String,
    /// The most connections of this process.
    pub max_connections: u32,
    /// The longest a call may take.
    pub timeout: Duration,
    /// After so long without a sign of life a process counts as dead.
    pub lifetime: Duration,
    /// Image bytes that nothing refers to stay at least so long after they came.
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
    doubts: RecentTimeout,
    objects: Objects,
    settings: PostgresSettings,
    /// This process among all.
    process: Uuid,
    changes: broadcast::Sender<Uuid>,
    deliveries: watch::Sender<()>,
    keys: watch::Sender<()>,
    levels: KnownLevels,
    graphs: descriptors::KnownGraphs,
    held: held::HeldJobs,
    /// Ends what works in the background.
    _background: DropGuard,
}

/// Change notices kept for a slow listener.
const CHANGES_KEPT: usize = 1024;

/// Statements prepared on each connection. Those that search a map name its table.
const STATEMENTS_KEPT: usize = 256;

impl PostgresStore {
    /// Opens the store for a process of that id; the schema must be up to date ([`migrate`]).
    pub async fn open(
        settings: PostgresSettings,
        objects: Objects,
        process: Uuid,
    ) -> Result<Self, StoreError> {
        let doubts = RecentTimeout::default();
        let pool = connect(&settings, &doubts)?;
        check_schema(&pool, &settings).await?;
        let background = CancellationToken::new();
        let inner = Arc::new(Inner {
            objects,
            process,
            changes: broadcast::channel(CHANGES_KEPT).0,
            deliveries: watch::Sender::new(()),
            keys: watch::Sender::new(()),
            levels: KnownLevels::default(),
            graphs: descriptors::KnownGraphs::default(),
            held: held::HeldJobs::default(),
            _background: background.clone().drop_guard(),
            pool,
            doubts,
            settings,
        });
        inner.sign_of_life().await?;
        // Whoever has the store hears of every change.
        let listener = inner.call(listener::connect(&inner.pool)).await?;
        let weak = Arc::downgrade(&inner);
        tokio::spawn(processes::keep_alive(weak.clone(), background.clone()));
        tokio::spawn(listener::listen(listener, weak.clone(), background.clone()));
        tokio::spawn(indexer::keep_indexed(weak, background));
        Ok(Self { inner })
    }
}

impl Inner {
    /// Does something within the time that a call has.
    async fn call<T>(
        &self,
        work: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, StoreError> {
        let limit = self.settings.timeout;
        let mut work = std::pin::pin!(work);
        tokio::time::timeout(limit, work.as_mut()).await.unwrap_or_else(|_| {
            // Before the work is dropped, and gives its connection back.
            self.doubts.arise();
            let limit = limit.as_millis();
            Err(unavailable(format!("it did not answer within {limit} ms (database.timeout_ms)")))
        })
    }

    async fn begin(&self) -> Result<Transaction<'static, Postgres>, StoreError> {
        Ok(self.pool.begin().await?)
    }

    /// How long a silent process counts as alive, in seconds.
    fn lifetime(&self) -> f64 {
        self.settings.lifetime.as_secs_f64()
    }
}

/// When a call last ran out of time. The pool asks every connection that it is given back whether it is alive,
/// and would wait for the answer of a dead one for ever; after such a call it does not.
#[derive(Clone, Default)]
struct RecentTimeout(Arc<Mutex<Option<Instant>>>);

impl RecentTimeout {
    fn arise(&self) {
        *self.0.lock() = Some(Instant::now());
    }

    /// Whether a call ran out of time so short a while ago that its connection is still to come.
    fn are_fresh(&self, within: Duration) -> bool {
        let arose = *self.0.lock();
        arose.is_some_and(|arose| arose.elapsed() < within)
    }
}

/// No connection yet: they are made when they are needed.
fn connect(settings: &PostgresSettings, doubts: &RecentTimeout) -> Result<PgPool, StoreError> {
    let options = PgConnectOptions::from_str(&settings.url).map_err(|error| {
        // The error may show the address, and that may hold a password.
        let what = match error {
            sqlx::Error::Configuration(_) => "it is no address",
            _ => "it cannot be used",
        };
        StoreError::Failed(format!(
            "database.url: {what}; write postgres://user:password@host:5432/database"
        ))
    })?;
    let ef_search = settings.index.ef_search.to_string();
    // The server gives up what nobody waits for any more.
    let patience = settings.timeout.as_millis().to_string();
    let options = options
        .application_name("whereabouts")
        .statement_cache_capacity(STATEMENTS_KEPT)
        .options([
            ("hnsw.ef_search", ef_search.as_str()),
            // Dead images are in the index until the next vacuum: look on until there are enough. Their order
            // is made anew, and the strict one leaves out what comes late.
            ("hnsw.iterative_scan", "relaxed_order"),
            // Compiling a search takes longer than searching.
            ("jit", "off"),
            ("statement_timeout", patience.as_str()),
            ("idle_in_transaction_session_timeout", patience.as_str()),
        ]);
    let (doubts, timeout) = (doubts.clone(), settings.timeout);
    Ok(PgPoolOptions::new()
        .max_connections(settings.max_connections)
        .acquire_timeout(settings.timeout)
        .acquire_slow_threshold(settings.timeout)
        .after_release(move |connection, _| {
            let doubtful = doubts.are_fresh(2 * timeout);
            Box::pin(async move {
                if doubtful {
                    let answer = tokio::time::timeout(timeout, connection.ping()).await;
                    answer.map_err(|_| sqlx::Error::PoolTimedOut)??;
                }
                Ok(true)
            })
        })
        .connect_lazy_with(options))
}

async fn check_schema(pool: &PgPool, settings: &PostgresSettings) -> Result<(), StoreError> {
    let looking = tokio::time::timeout(settings.timeout, schema_state(pool));
    match looking.await.map_err(|_| unavailable("it did not answer".to_owned()))?? {
        SchemaState::UpToDate => Ok(()),
        SchemaState::Behind { steps } => Err(StoreError::Conflict(format!(
            "the tables of the database are not up to date (steps missing: {steps}); run `whereabouts \
             migrate` with the same settings first"
        ))),
        SchemaState::Ahead { version } => Err(too_new(version)),
    }
}

/// The database was not there for a call, which may be made again.
fn unavailable(why: impl std::fmt::Display) -> StoreError {
    StoreError::Unavailable(format!("the database is not available: {why}; try again in a moment"))
}

/// What PostgreSQL reports, by the first two characters of its code, when it could do the same another
/// time: connections, lack of resources, operators, transactions that were in each other's way.
const PASSING: [&str; 5] = ["08", "40", "53", "57", "58"];

impl From<sqlx::Error> for StoreError {
    fn from(error: sqlx::Error) -> Self {
        match &error {
            sqlx::Error::Database(reported) => {
                let code = reported.code().unwrap_or_default();
                let class = code.get(..2).unwrap_or_default();
                // 25P02 and the like follow from what was reported before; 55P03 is a lock.
                if PASSING.contains(&class) || matches!(&*code, "55P03" | "25P02" | "25P03") {
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

/// Whether a table is missing: that of the descriptors of a map that was removed or reindexed.
fn is_missing_table(error: &sqlx::Error) -> bool {
    error.as_database_error().and_then(|error| error.code()).as_deref() == Some("42P01")
}

/// Whether a lock was not to be had in time.
fn is_locked(error: &sqlx::Error) -> bool {
    error.as_database_error().and_then(|error| error.code()).as_deref() == Some("55P03")
}

/// A record as it is stored.
fn record<T: Serialize>(value: &T) -> Result<String, StoreError> {
    serde_json::to_string(value).map_err(|error| StoreError::Failed(error.to_string()))
}

/// So long, in seconds. The clocks of processes differ, so that the database's counts: what is meant is how
/// long lies between two moments of the caller.
fn seconds(duration: SignedDuration) -> f64 {
    duration.as_secs_f64()
}

/// A count as PostgreSQL has it.
fn count(number: usize) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

/// A count that PostgreSQL gives.
fn counted(number: i64) -> usize {
    usize::try_from(number).unwrap_or(0)
}
