//! The descriptors of maps, each map's in a table of its own, and the search in them.
//!
//! A table holds the descriptors as they were given, in 32-bit floats. Its HNSW index is over the same
//! numbers in 16 bits (`halfvec`), which takes half the memory: the index proposes a few more images than are
//! wanted, and those are compared again with all their bits. `tests/store/search.rs` holds its recall.

use std::collections::HashSet;

use parking_lot::RwLock;
use sqlx::types::Json;
use sqlx::{AssertSqlSafe, PgConnection, Row};
use uuid::Uuid;

use super::super::changes::removed;
use super::super::{HardNegatives, StoreError};
use super::{Inner, count, is_locked, is_missing_table};
use whereabouts_core::{CalibrationSettings, Candidate, Descriptor, ImageId, Map, Pose};
use whereabouts_index::SearchMode;

/// The most numbers that pgvector indexes in 16 bits.
pub(super) const MOST_INDEXED: usize = 4000;

/// So many images more than are wanted come from the index, to be compared again.
const SPARE: usize = 8;

/// Longer descriptors do not fit into a page of a table, and are kept beside it.
const MOST_IN_PAGE: usize = 1900;

/// Tables of descriptors that no map and no draft has, by how their names begin.
const UNNEEDED: &str = "
    SELECT relname::text FROM pg_class
    WHERE relkind = 'r' AND pg_table_is_visible(oid) AND starts_with(relname::text, $1)
        AND relname::text NOT IN (
            SELECT 'descriptors_' || replace(uid::text, '-', '') || '_' || revision FROM maps
            UNION ALL
            SELECT 'descriptors_' || replace(map_uid::text, '-', '') || '_' || revision FROM drafts)";

/// The bytes of each map's descriptors and their index. A table that is replaced at this moment counts nothing.
pub(super) const SIZES: &str = "
    SELECT name, coalesce(pg_total_relation_size(to_regclass(
        'descriptors_' || replace(uid::text, '-', '') || '_' || revision)), 0)
    FROM maps ORDER BY name";

/// So long a table is waited for that is to be dropped, in milliseconds. Nobody can search it meanwhile.
const DROP_PATIENCE_MS: u32 = 200;

/// Maps whose index is known to be there, by uid and revision. None ever loses it.
#[derive(Default)]
pub(super) struct KnownGraphs(RwLock<HashSet<(Uuid, u32)>>);

impl KnownGraphs {
    fn has(&self, map: &Map) -> bool {
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

/// The table of a map's descriptors.
pub(super) fn table(uid: Uuid, revision: u32) -> String {
    format!("{}{revision}", table_prefix(uid))
}

fn table_prefix(uid: Uuid) -> String {
    format!("descriptors_{}_", uid.simple())
}

/// The name of its index.
pub(super) fn graph(uid: Uuid, revision: u32) -> String {
    format!("graph_{}_{revision}", uid.simple())
}

/// Makes the table of a map's descriptors.
pub(super) async fn make_table(connection: &mut PgConnection, map: &Map) -> Result<(), StoreError> {
    let (table, dim) = (table(map.uid, map.revision), map.dim);
    let storage = if dim <= MOST_IN_PAGE { "PLAIN" } else { "EXTERNAL" };
    let make = format!(
        "CREATE TABLE {table} (
             slot bigint PRIMARY KEY,
             descriptor vector({dim}) STORAGE {storage} NOT NULL)"
    );
    sqlx::query(AssertSqlSafe(make)).execute(connection).await?;
    Ok(())
}

/// Drops it, once nobody reads it.
pub(super) async fn drop_table(
    connection: &mut PgConnection,
    uid: Uuid,
    revision: u32,
) -> Result<(), StoreError> {
    let table = table(uid, revision);
    sqlx::query(AssertSqlSafe(format!("DROP TABLE IF EXISTS {table}"))).execute(connection).await?;
    Ok(())
}

/// The numbers of a descriptor that the database gives.
pub(super) fn descriptor_of(numbers: Vec<f32>) -> Option<Descriptor> {
    Descriptor::stored(numbers).ok()
}

/// An image that a search found.
struct Found {
    slot: i64,
    id: ImageId,
    pose: Option<Pose>,
    similarity: f64,
}

impl Inner {
    /// Refuses a map whose descriptors are not those that the caller knows.
    pub(super) async fn check_revision(&self, map: &Map) -> Result<(), StoreError> {
        let stored = sqlx::query_scalar("SELECT revision FROM maps WHERE uid = $1").bind(map.uid);
        let stored: Option<i64> = stored.fetch_optional(&self.pool).await?;
        match stored {
            None => Err(removed(map)),
            Some(revision) if i64::from(map.revision) == revision => Ok(()),
            Some(_) => Err(StoreError::Superseded(map.name.clone())),
        }
    }

    /// Refuses a map that is gone.
    pub(super) async fn check_there(&self, map: &Map) -> Result<(), StoreError> {
        match self.check_revision(map).await {
            Err(StoreError::Superseded(_)) => Ok(()),
            checked => checked,
        }
    }

    /// What to say of a statement that failed because of the map's table.
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

    /// Drops the tables of descriptors that no map and no draft has any more, of one uid or of all. One that is
    /// in use, or whose index is being built, is left to a later look.
    ///
    /// Never in the transaction that made them so: whoever adds an image locks the table and then the map's
    /// row, and a transaction that locked the two in the other order would wait for it, and it for that.
    pub(super) async fn drop_unneeded(&self, uid: Option<Uuid>) -> Result<(), StoreError> {
        let prefix = uid.map_or_else(|| "descriptors_".to_owned(), table_prefix);
        let unneeded = sqlx::query_scalar(UNNEEDED).bind(prefix);
        let unneeded: Vec<String> =
            self.call(async { Ok(unneeded.fetch_all(&self.pool).await?) }).await?;
        for table in unneeded {
            self.call(self.drop_if_unneeded(&table)).await?;
        }
        Ok(())
    }

    /// The same after a change that is done: what cannot be dropped is left to the janitor.
    pub(super) async fn drop_left(&self, uid: Uuid) {
        if let Err(error) = self.drop_unneeded(Some(uid)).await {
            tracing::warn!(%error, "old descriptors are left to a later look");
        }
    }

    async fn drop_if_unneeded(&self, table: &str) -> Result<(), StoreError> {
        let mut tx = self.begin().await?;
        for statement in [
            format!("SET LOCAL lock_timeout = {DROP_PATIENCE_MS}"),
            format!("LOCK TABLE {table} IN ACCESS EXCLUSIVE MODE"),
        ] {
            match sqlx::raw_sql(AssertSqlSafe(statement)).execute(&mut *tx).await {
                Err(error) if is_missing_table(&error) || is_locked(&error) => return Ok(()),
                done => done?,
            };
        }
        // Another draft of the same revision may have begun meanwhile.
        let still = sqlx::query_scalar(UNNEEDED).bind(table);
        let still: Vec<String> = still.fetch_all(&mut *tx).await?;
        if still.iter().any(|still| still == table) {
            let drop = format!("DROP TABLE {table}");
            sqlx::raw_sql(AssertSqlSafe(drop)).execute(&mut *tx).await?;
        }
        Ok(tx.commit().await?)
    }

    /// Whether the map's index is there.
    async fn has_graph(&self, map: &Map) -> Result<bool, StoreError> {
        if self.graphs.has(map) {
            return Ok(true);
        }
        let there = sqlx::query_scalar("SELECT graph FROM maps WHERE uid = $1 AND revision = $2")
            .bind(map.uid)
            .bind(i64::from(map.revision));
        let there: Option<bool> = there.fetch_optional(&self.pool).await?;
        if there == Some(true) {
            self.graphs.add(map);
        }
        Ok(there == Some(true))
    }

    pub(super) async fn candidates(
        &self,
        map: &Map,
        query: &Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError> {
        Ok(candidates(self.find(map, query, k, mode).await?))
    }

    async fn find(
        &self,
        map: &Map,
        query: &Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Found>, StoreError> {
        if mode == SearchMode::Fast && self.has_graph(map).await? {
            let found = self.nearest(map, query, k, true).await?;
            // Among many removed images an index can lose its way to the rest, and it is not looked through
            // to its end.
            if found.len() == k {
                return Ok(found);
            }
        }
        self.nearest(map, query, k, false).await
    }

    async fn nearest(
        &self,
        map: &Map,
        query: &Descriptor,
        k: usize,
        by_graph: bool,
    ) -> Result<Vec<Found>, StoreError> {
        let (table, dim) = (table(map.uid, map.revision), map.dim);
        let nearest = match by_graph {
            true => format!(
                "SELECT slot, descriptor FROM {table}
                 ORDER BY descriptor::halfvec({dim}) <=> $1::real[]::halfvec({dim}) LIMIT $3"
            ),
            false => format!("SELECT slot, descriptor FROM {table}"),
        };
        // OFFSET 0 has images looked up one by one. A plan made for any LIMIT would read the whole map's.
        let sql = format!(
            "SELECT n.slot, i.id, i.pose, 1 - n.distance AS similarity
             FROM (SELECT slot, descriptor <=> $1::real[]::vector AS distance
                   FROM ({nearest}) nearest ORDER BY distance, slot LIMIT $2) n
             JOIN LATERAL (SELECT id, pose FROM images
                           WHERE map_uid = $4 AND slot = n.slot OFFSET 0) i ON true
             JOIN maps m ON m.uid = $4 AND m.revision = $5
             ORDER BY n.distance, n.slot"
        );
        let wanted = k + SPARE;
        let search = sqlx::query(AssertSqlSafe(sql))
            .bind(query.as_slice())
            .bind(count(k))
            .bind(count(wanted))
            .bind(map.uid)
            .bind(i64::from(map.revision));
        let rows = if by_graph && wanted > self.settings.index.ef_search {
            let mut tx = self.begin().await?;
            // For this search alone: as many points are looked at as it takes to find so many.
            sqlx::query("SELECT set_config('hnsw.ef_search', $1, true)")
                .bind(wanted.min(1000).to_string())
                .execute(&mut *tx)
                .await?;
            search.fetch_all(&mut *tx).await
        } else {
            search.fetch_all(&self.pool).await
        };
        let rows = match rows {
            Ok(rows) => rows,
            Err(error) => return Err(self.explain(map, error).await),
        };
        if rows.is_empty() {
            self.check_revision(map).await?;
        }
        rows.into_iter()
            .map(|row| {
                let pose: Option<Json<Pose>> = row.try_get("pose")?;
                Ok(Found {
                    slot: row.try_get("slot")?,
                    id: image_id(row.try_get("id")?)?,
                    pose: pose.map(|Json(pose)| pose),
                    similarity: row.try_get("similarity")?,
                })
            })
            .collect()
    }

    /// Images spread over the map, each with the `k` most similar ones of other places.
    pub(super) async fn similar_places(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError> {
        let places: Vec<(i64, String, Option<Json<Pose>>)> =
            sqlx::query_as("SELECT slot, id, pose FROM images WHERE map_uid = $1 ORDER BY slot")
                .bind(map.uid)
                .fetch_all(&self.pool)
                .await?;
        let mut asked = Vec::new();
        for at in (0..places.len()).step_by(settings.step(places.len())) {
            let (slot, id, pose) = &places[at];
            let Some(descriptor) = self.descriptor(map, *slot).await? else { continue };
            let pose = pose.as_ref().map(|Json(pose)| *pose);
            let of_another_place = |found: &Found| {
                let position = places.partition_point(|(slot, ..)| *slot < found.slot);
                settings.are_apart(places.len(), (at, pose), (position, found.pose))
            };
            // Twice as many, until enough of them are of other places.
            let mut wanted = k + 2 * settings.place_radius(places.len()) + 1;
            let others = loop {
                let found = self.find(map, &descriptor, wanted, SearchMode::Fast).await?;
                let all = found.len() < wanted;
                let others: Vec<Found> =
                    found.into_iter().filter(of_another_place).take(k).collect();
                if others.len() == k || all {
                    break others;
                }
                wanted *= 2;
            };
            let image_id = image_id(id.clone())?;
            asked.push(HardNegatives { image_id, others: candidates(others) });
        }
        Ok(asked)
    }

    async fn descriptor(&self, map: &Map, slot: i64) -> Result<Option<Descriptor>, StoreError> {
        let table = table(map.uid, map.revision);
        let sql = format!("SELECT descriptor::real[] FROM {table} WHERE slot = $1");
        let found = sqlx::query_scalar(AssertSqlSafe(sql)).bind(slot);
        match found.fetch_optional(&self.pool).await {
            Ok(numbers) => Ok(numbers.and_then(descriptor_of)),
            Err(error) => Err(self.explain(map, error).await),
        }
    }
}

pub(super) fn image_id(id: String) -> Result<ImageId, StoreError> {
    id.parse().map_err(|_| {
        StoreError::Damaged("an image of the database has no valid id; restore a backup".into())
    })
}

fn candidates(found: Vec<Found>) -> Vec<Candidate> {
    let candidate = |(position, found): (usize, Found)| Candidate {
        rank: position + 1,
        image_id: found.id,
        // Rounding can carry the cosine of equal pictures just past 1.
        similarity: (found.similarity as f32).clamp(-1.0, 1.0),
        pose: found.pose,
    };
    found.into_iter().enumerate().map(candidate).collect()
}
