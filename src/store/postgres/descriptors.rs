//! The descriptors of maps, one table for each map.
//!
//! A table stores the descriptors at full precision, as 32-bit floats. Its HNSW index is over the same
//! numbers in 16 bits (`halfvec`), which halves its memory. Of images that are equal in 16 bits it contains
//! the first only, because pgvector loses other images among many equal ones (`migrations/0003_twins.sql`).

use std::collections::HashSet;

use parking_lot::RwLock;
use sqlx::{AssertSqlSafe, PgConnection};
use uuid::Uuid;

use super::super::StoreError;
use super::super::changes::removed;
use super::{Inner, is_locked, is_missing_table};
use whereabouts_core::{Descriptor, Map};

/// The maximum number of dimensions that pgvector indexes in 16 bits.
pub(super) const MAX_INDEXED_DIM: usize = 4000;

/// Descriptors with more dimensions do not fit into a table's page, and are stored out of line.
const MAX_INLINE_DIM: usize = 1900;

/// Selects the descriptor tables that belong to no map or draft, by the prefix of their names.
const UNUSED_TABLES: &str = "
    SELECT relname::text FROM pg_class
    WHERE relkind = 'r' AND pg_table_is_visible(oid) AND starts_with(relname::text, $1)
        AND relname::text NOT IN (
            SELECT 'descriptors_' || replace(uid::text, '-', '') || '_' || revision FROM maps
            UNION ALL
            SELECT 'descriptors_' || replace(map_uid::text, '-', '') || '_' || revision FROM drafts)";

/// Selects the size of each map's descriptors and their index. A table that is being replaced counts as
/// empty.
pub(super) const SIZES: &str = "
    SELECT name, coalesce(pg_total_relation_size(to_regclass(
        'descriptors_' || replace(uid::text, '-', '') || '_' || revision)), 0)
    FROM maps ORDER BY name";

/// How long to wait for the lock of a table to drop, in milliseconds. Searches of it wait meanwhile.
const DROP_LOCK_TIMEOUT_MS: u32 = 200;

/// Maps that are known to have an index, by uid and revision. An index is never dropped alone, so entries
/// stay valid.
#[derive(Default)]
pub(super) struct KnownGraphs(RwLock<HashSet<(Uuid, u32)>>);

impl KnownGraphs {
    pub fn has(&self, map: &Map) -> bool {
        let known = self.0.read();
        known.contains(&(map.uid, map.revision))
    }

    pub fn add(&self, map: &Map) {
        let mut known = self.0.write();
        known.retain(|(uid, revision)| *uid != map.uid || *revision == map.revision);
        known.insert((map.uid, map.revision));
    }

    pub fn forget(&self, uid: Uuid) {
        let mut known = self.0.write();
        known.retain(|(other, _)| *other != uid);
    }
}

/// Returns the name of the table of a map's descriptors.
pub(super) fn table(uid: Uuid, revision: u32) -> String {
    format!("{}{revision}", table_prefix(uid))
}

fn table_prefix(uid: Uuid) -> String {
    format!("descriptors_{}_", uid.simple())
}

/// What belongs to the descriptors of a map's revision.
pub(super) struct Names {
    pub table: String,
    /// The HNSW index of the first of equal descriptors.
    pub graph: String,
    /// The index of what equal descriptors have in common.
    pub codes: String,
    /// The HNSW index of all descriptors, which earlier versions built.
    pub old_graph: String,
}

impl Names {
    pub fn of(uid: Uuid, revision: u32) -> Self {
        let name = |what: &str| format!("{what}_{}_{revision}", uid.simple());
        Self {
            table: table(uid, revision),
            graph: name("firsts"),
            codes: name("codes"),
            old_graph: name("graph"),
        }
    }
}

/// Creates the table of a map's descriptors.
pub(super) async fn create_table(
    connection: &mut PgConnection,
    map: &Map,
) -> Result<(), StoreError> {
    let (table, dim) = (table(map.uid, map.revision), map.dim);
    let storage = if dim <= MAX_INLINE_DIM { "PLAIN" } else { "EXTERNAL" };
    let create = format!(
        "CREATE TABLE {table} (
             slot bigint PRIMARY KEY,
             descriptor vector({dim}) STORAGE {storage} NOT NULL)"
    );
    sqlx::query(AssertSqlSafe(create)).execute(connection).await?;
    Ok(())
}

/// Drops the table of a map's descriptors, after waiting for its readers.
pub(super) async fn drop_table(
    connection: &mut PgConnection,
    uid: Uuid,
    revision: u32,
) -> Result<(), StoreError> {
    let table = table(uid, revision);
    sqlx::query(AssertSqlSafe(format!("DROP TABLE IF EXISTS {table}"))).execute(connection).await?;
    Ok(())
}

/// Converts the numbers of a stored descriptor.
pub(super) fn descriptor_of(numbers: Vec<f32>) -> Option<Descriptor> {
    Descriptor::stored(numbers).ok()
}

impl Inner {
    /// Refuses a map that was deleted, or reindexed after the caller read it.
    pub(super) async fn check_revision(&self, map: &Map) -> Result<(), StoreError> {
        let stored = sqlx::query_scalar("SELECT revision FROM maps WHERE uid = $1").bind(map.uid);
        let stored: Option<i64> = stored.fetch_optional(&self.pool).await?;
        match stored {
            None => Err(removed(map)),
            Some(revision) if i64::from(map.revision) == revision => Ok(()),
            Some(_) => Err(StoreError::Superseded(map.name.clone())),
        }
    }

    /// Refuses a map that was deleted.
    pub(super) async fn check_exists(&self, map: &Map) -> Result<(), StoreError> {
        match self.check_revision(map).await {
            Err(StoreError::Superseded(_)) => Ok(()),
            checked => checked,
        }
    }

    /// Converts the error of a statement that uses the map's table.
    pub(super) async fn explain(&self, map: &Map, error: sqlx::Error) -> StoreError {
        if !is_missing_table(&error) {
            return error.into();
        }
        match self.check_revision(map).await {
            Err(why) => why,
            Ok(()) => StoreError::Damaged(format!(
                "the descriptors of the map {} are gone; restore a backup",
                map.name
            )),
        }
    }

    /// Drops the descriptor tables that belong to no map or draft, of one uid or of all. A table that is in
    /// use, or whose index is being built, is skipped and dropped by a later call.
    ///
    /// This must not run in the transaction that made a table unused: adding an image locks the table and
    /// then the map's row, so locking them in the opposite order would deadlock.
    pub(super) async fn drop_unused_tables(&self, uid: Option<Uuid>) -> Result<(), StoreError> {
        let prefix = uid.map_or_else(|| "descriptors_".to_owned(), table_prefix);
        let unused = sqlx::query_scalar(UNUSED_TABLES).bind(prefix);
        let unused: Vec<String> =
            self.call(async { Ok(unused.fetch_all(&self.pool).await?) }).await?;
        for table in unused {
            self.call(self.drop_if_unused(&table)).await?;
        }
        Ok(())
    }

    /// Drops the unused tables of one uid. A failure is only logged, because garbage collection tries
    /// again.
    pub(super) async fn drop_unused_tables_of(&self, uid: Uuid) {
        if let Err(error) = self.drop_unused_tables(Some(uid)).await {
            tracing::warn!(%error, "cannot drop old descriptors yet");
        }
    }

    async fn drop_if_unused(&self, table: &str) -> Result<(), StoreError> {
        let mut tx = self.begin().await?;
        for statement in [
            format!("SET LOCAL lock_timeout = {DROP_LOCK_TIMEOUT_MS}"),
            format!("LOCK TABLE {table} IN ACCESS EXCLUSIVE MODE"),
        ] {
            match sqlx::raw_sql(AssertSqlSafe(statement)).execute(&mut *tx).await {
                Err(error) if is_missing_table(&error) || is_locked(&error) => return Ok(()),
                done => done?,
            };
        }
        // Check again, because another draft of the same revision may have begun meanwhile.
        let unused = sqlx::query_scalar(UNUSED_TABLES).bind(table);
        let unused: Vec<String> = unused.fetch_all(&mut *tx).await?;
        if unused.iter().any(|unused| unused == table) {
            let drop = format!("DROP TABLE {table}");
            sqlx::raw_sql(AssertSqlSafe(drop)).execute(&mut *tx).await?;
        }
        Ok(tx.commit().await?)
    }
}
