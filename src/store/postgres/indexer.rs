//! Builds the HNSW indexes of maps that have outgrown exact search, in the background.
//!
//! PostgreSQL builds an index while images are added and removed, and puts every later image into it. An
//! advisory lock of the connection keeps two processes from building the same one; nobody waits for it.

use std::sync::Weak;
use std::time::Duration;

use sqlx::types::Json;
use sqlx::{AssertSqlSafe, PgConnection};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::super::StoreError;
use super::descriptors::{MOST_INDEXED, graph, table};
use super::{Inner, count};
use whereabouts_core::Map;

/// The pause between two looks for maps without an index.
const PAUSE: Duration = Duration::from_secs(1);

/// Looks until the store is closed.
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
            () = tokio::time::sleep(PAUSE) => {}
        }
    }
}

impl Inner {
    /// Maps that have too many images to be searched exactly, and no index.
    async fn outgrown(&self) -> Result<Vec<Map>, StoreError> {
        let maps: Vec<Json<Map>> = sqlx::query_scalar(
            "SELECT record FROM maps WHERE NOT graph AND (
                 SELECT sum(images) FROM image_counts WHERE map_uid = uid) > $1",
        )
        .bind(count(self.settings.index.exact_up_to))
        .fetch_all(&self.pool)
        .await?;
        Ok(maps.into_iter().map(|Json(map)| map).filter(|map| map.dim <= MOST_INDEXED).collect())
    }

    /// Builds the index of a map, unless another process is at it.
    async fn build_graph(&self, map: &Map) -> Result<(), StoreError> {
        let lock = lock_of(map.uid);
        let mut connection = self.pool.acquire().await?;
        let locked = sqlx::query_scalar("SELECT pg_try_advisory_lock($1)").bind(lock);
        if !locked.fetch_one(&mut *connection).await? {
            return Ok(());
        }
        // Whatever becomes of it, the connection is closed, and the lock goes with it.
        let mut connection = connection.detach();
        let began = std::time::Instant::now();
        self.index(&mut connection, map).await?;
        sqlx::query("UPDATE maps SET graph = true WHERE uid = $1 AND revision = $2")
            .bind(map.uid)
            .bind(i64::from(map.revision))
            .execute(&mut connection)
            .await?;
        tracing::info!(map = %map.name, seconds = began.elapsed().as_secs_f32(), "an index was built");
        Ok(())
    }

    /// Makes the index of a map's descriptors. The map need not serve yet.
    pub(super) async fn index(
        &self,
        connection: &mut PgConnection,
        map: &Map,
    ) -> Result<(), StoreError> {
        let (index, memory) = (self.settings.index, self.settings.index_memory_mib);
        let (table, graph) = (table(map.uid, map.revision), graph(map.uid, map.revision));
        let (dim, m, construction) = (map.dim, index.m, index.ef_construction);
        let there = "SELECT indisvalid FROM pg_index WHERE indexrelid = to_regclass($1)";
        let there: Option<bool> =
            sqlx::query_scalar(there).bind(&graph).fetch_optional(&mut *connection).await?;
        if there == Some(true) {
            // Built for a process that ended before it could say so.
            return Ok(());
        }
        for statement in [
            "SET statement_timeout = 0".to_owned(),
            format!("SET maintenance_work_mem = '{memory}MB'"),
            // Half of one, from a build that broke off.
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

/// The advisory lock of whoever builds the index of a map.
fn lock_of(uid: Uuid) -> i64 {
    let (high, low) = uid.as_u64_pair();
    (high ^ low).cast_signed()
}
