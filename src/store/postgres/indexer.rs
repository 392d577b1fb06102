//! Builds the HNSW indexes of maps that have outgrown exact search, in the background.
//!
//! PostgreSQL builds an index while images are added and removed, and adds later images to it. An
//! advisory lock of the connection keeps two processes from building the same index; nothing waits for
//! it.

use std::sync::Weak;
use std::time::Duration;

use sqlx::types::Json;
use sqlx::{AssertSqlSafe, PgConnection};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::super::StoreError;
use super::descriptors::{MAX_INDEXED_DIM, graph, table};
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
            "SELECT record FROM maps WHERE NOT graph AND (
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
        sqlx::query("UPDATE maps SET graph = true WHERE uid = $1 AND revision = $2")
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
        let (table, graph) = (table(map.uid, map.revision), graph(map.uid, map.revision));
        let (dim, m, construction) = (map.dim, index.m, index.ef_construction);
        let valid = "SELECT indisvalid FROM pg_index WHERE indexrelid = to_regclass($1)";
        let valid: Option<bool> =
            sqlx::query_scalar(valid).bind(&graph).fetch_optional(&mut *connection).await?;
        if valid == Some(true) {
            // Built by a process that ended before it could record that.
            return Ok(());
        }
        for statement in [
            "SET statement_timeout = 0".to_owned(),
            format!("SET maintenance_work_mem = '{memory}MB'"),
            // An invalid index is left by an interrupted build.
            format!("DROP INDEX CONCURRENTLY IF EXISTS {graph}"),
            format!(
                "CREATE INDEX CONCURRENTLY {graph} ON {table}
                 USING hnsw ((descriptor::halfvec({dim})) halfvec_cosine_ops)
                 WITH (m = {m}, ef_construction = {construction})"
            ),
        ] {
            sqlx::raw_sql(AssertSqlSafe(statement)).execute(&mut *connection).await?;
        }
        Ok(())
    }
}

/// Returns the advisory lock for building the index of a map.
fn lock_of(uid: Uuid) -> i64 {
    let (high, low) = uid.as_u64_pair();
    (high ^ low).cast_signed()
}
