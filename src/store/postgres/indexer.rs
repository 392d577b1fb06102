//! Builds the HNSW indexes of maps that have outgrown exact search, in the background.
//!
//! PostgreSQL builds an index while images are added and removed, and adds later images to it. An
//! advisory lock of the connection keeps two processes from building the same index; nothing waits for
//! it.

use std::sync::Weak;
use std::time::Duration;

use sqlx::types::Json;
use sqlx::{AssertSqlSafe, Connection, PgConnection};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::super::StoreError;
use super::descriptors::{MAX_INDEXED_DIM, Names};
use super::{Inner, count};
use whereabouts_core::Map;

/// The interval between checks for maps without an index.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Builds missing indexes until the store is closed.
pub(super) async fn keep_indexed(store: Weak<Inner>, closed: CancellationToken) {
    while let Some(inner) = store.upgrade() {
        let building = async {
            for map in inner.call(inner.outgrown()).await? {
                inner.build_graph(&map).await?;
            }
            Ok::<_, StoreError>(())
        };
        let built = tokio::select! {
            () = closed.cancelled() => return,
            built = building => built,
        };
        if let Err(error) = built {
            tracing::warn!(%error, "the index of a map could not be built; it is searched exactly");
        }
        drop(inner);
        tokio::select! {
            () = closed.cancelled() => return,
            () = tokio::time::sleep(CHECK_INTERVAL) => {}
        }
    }
}

impl Inner {
    /// Returns the maps that have too many images for exact search, but no index.
    async fn outgrown(&self) -> Result<Vec<Map>, StoreError> {
        let maps: Vec<Json<Map>> = sqlx::query_scalar(
            "SELECT record FROM maps WHERE indexed_revision IS DISTINCT FROM revision AND (
                 SELECT sum(images) FROM image_counts WHERE map_uid = uid) > $1",
        )
        .bind(count(self.settings.index.exact_up_to))
        .fetch_all(&self.pool)
        .await?;
        Ok(maps.into_iter().map(|Json(map)| map).filter(|map| map.dim <= MAX_INDEXED_DIM).collect())
    }

    /// Builds the index of a map, unless another process is building it.
    async fn build_graph(&self, map: &Map) -> Result<(), StoreError> {
        let lock = lock_of(map.uid);
        let mut connection = self.pool.acquire().await?;
        let locked = sqlx::query_scalar("SELECT pg_try_advisory_lock($1)").bind(lock);
        if !locked.fetch_one(&mut *connection).await? {
            return Ok(());
        }
        // A detached connection is closed when it is dropped, which releases the lock.
        let mut connection = connection.detach();
        let began = std::time::Instant::now();
        self.create_index(&mut connection, map).await?;
        sqlx::query(
            "UPDATE maps SET graph = true, indexed_revision = $2 WHERE uid = $1 AND revision = $2",
        )
        .bind(map.uid)
        .bind(i64::from(map.revision))
        .execute(&mut connection)
        .await?;
        tracing::info!(map = %map.name, seconds = began.elapsed().as_secs_f32(), "an index was built");
        Ok(())
    }

    /// Creates the index of a map's descriptors, which may be those of a draft.
    pub(super) async fn create_index(
        &self,
        connection: &mut PgConnection,
        map: &Map,
    ) -> Result<(), StoreError> {
        let (index, memory) = (self.settings.index, self.settings.index_memory_mib);
        let names = Names::of(map.uid, map.revision);
        let Names { table, graph, codes, old_graph } = &names;
        let (dim, m, construction) = (map.dim, index.m, index.ef_construction);
        run(connection, "SET statement_timeout = 0").await?;
        run(connection, &format!("SET maintenance_work_mem = '{memory}MB'")).await?;
        run(
            connection,
            &format!(
                "ALTER TABLE {table} ADD COLUMN IF NOT EXISTS twin boolean NOT NULL DEFAULT false"
            ),
        )
        .await?;
        let on = format!("ON {table} (descriptor_code(descriptor), twin)");
        create_concurrently(connection, codes, &on).await?;
        mark_twins(connection, table).await?;
        let on = format!(
            "ON {table} USING hnsw ((descriptor::halfvec({dim})) halfvec_cosine_ops)
             WITH (m = {m}, ef_construction = {construction}) WHERE NOT twin"
        );
        create_concurrently(connection, graph, &on).await?;
        run(connection, &format!("DROP INDEX CONCURRENTLY IF EXISTS {old_graph}")).await
    }
}

/// Creates an index while its table is used, unless it is there. An interrupted build leaves an invalid one.
async fn create_concurrently(
    connection: &mut PgConnection,
    name: &str,
    on: &str,
) -> Result<(), StoreError> {
    let valid = "SELECT indisvalid FROM pg_index WHERE indexrelid = to_regclass($1)";
    let valid: Option<bool> =
        sqlx::query_scalar(valid).bind(name).fetch_optional(&mut *connection).await?;
    if valid != Some(true) {
        run(connection, &format!("DROP INDEX CONCURRENTLY IF EXISTS {name}")).await?;
        run(connection, &format!("CREATE INDEX CONCURRENTLY {name} {on}")).await?;
    }
    Ok(())
}

/// Marks all but the first of equal descriptors, and keeps it so from then on (`migrations/0003_twins.sql`). Additions
/// and removals wait meanwhile, searches do not.
async fn mark_twins(connection: &mut PgConnection, table: &str) -> Result<(), StoreError> {
    let mut tx = connection.begin().await?;
    for statement in [
        format!("LOCK TABLE {table} IN SHARE ROW EXCLUSIVE MODE"),
        format!(
            "CREATE OR REPLACE TRIGGER mark_twin BEFORE INSERT ON {table}
             FOR EACH ROW EXECUTE FUNCTION mark_twin()"
        ),
        format!(
            "CREATE OR REPLACE TRIGGER replace_first AFTER DELETE ON {table}
             FOR EACH ROW WHEN (NOT OLD.twin) EXECUTE FUNCTION replace_first()"
        ),
        format!(
            "UPDATE {table} marked SET twin = true FROM (
                 SELECT slot, row_number() OVER (
                     PARTITION BY descriptor_code(descriptor) ORDER BY twin, slot) AS place
                 FROM {table}) placed
             WHERE marked.slot = placed.slot AND place > 1 AND NOT twin"
        ),
    ] {
        run(&mut tx, &statement).await?;
    }
    Ok(tx.commit().await?)
}

async fn run(connection: &mut PgConnection, statement: &str) -> Result<(), StoreError> {
    sqlx::raw_sql(AssertSqlSafe(statement.to_owned())).execute(connection).await?;
    Ok(())
}

/// Returns the advisory lock for building the index of a map.
fn lock_of(uid: Uuid) -> i64 {
    let (high, low) = uid.as_u64_pair();
    (high ^ low).cast_signed()
}
