//! The descriptors of maps, one table for each map, and the search in them.
//!
//! A table stores the descriptors at full precision, as 32-bit floats. Its HNSW index is over the same
//! numbers in 16 bits (`halfvec`), which halves its memory: the index returns a few more images than
//! requested, and these are ranked again at full precision. Of images that are equal in 16 bits it contains
//! the first only, because pgvector loses other images among many equal ones; a search adds the *twins* of
//! what it found (`migrations/0003_twins.sql`). `tests/store/search.rs` checks the recall.

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

/// The maximum number of dimensions that pgvector indexes in 16 bits.
pub(super) const MAX_INDEXED_DIM: usize = 4000;

/// Number of images requested from the index in addition to `k`, to be ranked again.
const OVERFETCH: usize = 8;

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

/// An image that a search found.
struct Found {
    slot: i64,
    id: ImageId,
    pose: Option<Pose>,
    similarity: f64,
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

    /// Whether the map has an index.
    async fn has_graph(&self, map: &Map) -> Result<bool, StoreError> {
        if self.graphs.has(map) {
            return Ok(true);
        }
        let graph = sqlx::query_scalar(
            "SELECT coalesce(indexed_revision = revision, false) FROM maps
             WHERE uid = $1 AND revision = $2",
        )
        .bind(map.uid)
        .bind(i64::from(map.revision));
        let graph: Option<bool> = graph.fetch_optional(&self.pool).await?;
        if graph == Some(true) {
            self.graphs.add(map);
        }
        Ok(graph == Some(true))
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
            // If many images were removed, an index scan may end before it has found enough.
            if found.len() >= k {
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
        // OFFSET 0 makes the planner look up rows one by one; a generic plan would read all of the map's.
        let nearest = match by_graph {
            true => format!(
                "WITH firsts AS MATERIALIZED (
                     SELECT slot, descriptor FROM {table} WHERE NOT twin
                     ORDER BY descriptor::halfvec({dim}) <=> $1::real[]::halfvec({dim}) LIMIT $3)
                 SELECT slot, descriptor FROM firsts
                 UNION ALL
                 SELECT twins.slot, twins.descriptor FROM firsts
                 JOIN LATERAL (
                     SELECT slot, descriptor FROM {table}
                     WHERE descriptor_code(descriptor) = descriptor_code(firsts.descriptor) AND twin
                     OFFSET 0) twins ON true"
            ),
            false => format!("SELECT slot, descriptor FROM {table}"),
        };
        let sql = format!(
            "SELECT n.slot, i.id, i.pose, 1 - n.distance AS similarity
             FROM (SELECT slot, descriptor <=> $1::real[]::vector AS distance
                   FROM ({nearest}) nearest ORDER BY distance, slot LIMIT $2) n
             JOIN LATERAL (SELECT id, pose FROM images
                           WHERE map_uid = $4 AND slot = n.slot OFFSET 0) i ON true
             JOIN maps m ON m.uid = $4 AND m.revision = $5
             ORDER BY n.distance, n.slot"
        );
        let fetched = k + OVERFETCH;
        let search = sqlx::query(AssertSqlSafe(sql))
            .bind(query.as_slice())
            .bind(count(k))
            .bind(count(fetched))
            .bind(map.uid)
            .bind(i64::from(map.revision));
        let rows = if by_graph && fetched > self.settings.index.ef_search {
            let mut tx = self.begin().await?;
            // Raise ef_search for this search only, so that it can return enough images.
            sqlx::query("SELECT set_config('hnsw.ef_search', $1, true)")
                .bind(fetched.min(1000).to_string())
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

    /// Samples images evenly across the map and returns the `k` hardest negatives of each.
    pub(super) async fn find_hard_negatives(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError> {
        let images: Vec<(i64, String, Option<Json<Pose>>)> =
            sqlx::query_as("SELECT slot, id, pose FROM images WHERE map_uid = $1 ORDER BY slot")
                .bind(map.uid)
                .fetch_all(&self.pool)
                .await?;
        let mut samples = Vec::new();
        for at in (0..images.len()).step_by(settings.step(images.len())) {
            let (slot, id, pose) = &images[at];
            let Some(descriptor) = self.descriptor(map, *slot).await? else { continue };
            let pose = pose.as_ref().map(|Json(pose)| *pose);
            let of_another_place = |found: &Found| {
                let position = images.partition_point(|(slot, ..)| *slot < found.slot);
                settings.are_apart(images.len(), (at, pose), (position, found.pose))
            };
            // Double the limit until enough results are of other places.
            let mut limit = k + 2 * settings.place_radius(images.len()) + 1;
            let others = loop {
                let found = self.find(map, &descriptor, limit, SearchMode::Fast).await?;
                let exhausted = found.len() < limit;
                let others: Vec<Found> =
                    found.into_iter().filter(of_another_place).take(k).collect();
                if others.len() == k || exhausted {
                    break others;
                }
                limit *= 2;
            };
            let image_id = image_id(id.clone())?;
            samples.push(HardNegatives { image_id, others: candidates(others) });
        }
        Ok(samples)
    }

    /// The descriptors in some slots.
    pub(super) async fn descriptors_in(
        &self,
        map: &Map,
        slots: &[usize],
    ) -> Result<Vec<Option<Descriptor>>, StoreError> {
        let table = table(map.uid, map.revision);
        let sql = format!(
            "SELECT d.descriptor::real[] FROM unnest($1) WITH ORDINALITY wanted (slot, place)
             LEFT JOIN {table} d USING (slot) ORDER BY wanted.place"
        );
        let slots: Vec<i64> = slots.iter().map(|slot| count(*slot)).collect();
        let found = sqlx::query_scalar(AssertSqlSafe(sql)).bind(slots).fetch_all(&self.pool).await;
        match found {
            Ok(found) => {
                let numbers = found.into_iter().map(|numbers: Option<Vec<f32>>| numbers);
                Ok(numbers.map(|numbers| numbers.and_then(descriptor_of)).collect())
            }
            Err(error) => Err(self.explain(map, error).await),
        }
    }

    /// The dot products of a vector and the descriptors in some slots.
    pub(super) async fn similarities_to(
        &self,
        map: &Map,
        vector: &[f32],
        slots: &[usize],
    ) -> Result<Vec<Option<f32>>, StoreError> {
        if slots.is_empty() {
            // The vector may be empty, too, which pgvector has none of.
            return Ok(Vec::new());
        }
        let table = table(map.uid, map.revision);
        // <#> is the negative dot product.
        let sql = format!(
            "SELECT (-(d.descriptor <#> $2::real[]::vector))::real
             FROM unnest($1) WITH ORDINALITY wanted (slot, place)
             LEFT JOIN {table} d USING (slot) ORDER BY wanted.place"
        );
        let slots: Vec<i64> = slots.iter().map(|slot| count(*slot)).collect();
        let found = sqlx::query_scalar(AssertSqlSafe(sql)).bind(slots).bind(vector);
        match found.fetch_all(&self.pool).await {
            Ok(found) => Ok(found),
            Err(error) => Err(self.explain(map, error).await),
        }
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
        StoreError::Damaged("a stored image has an invalid id; restore a backup".into())
    })
}

fn candidates(found: Vec<Found>) -> Vec<Candidate> {
    let candidate = |(position, found): (usize, Found)| Candidate {
        rank: position + 1,
        image_id: found.id,
        // Rounding can push the cosine of identical pictures slightly above 1.
        similarity: (found.similarity as f32).clamp(-1.0, 1.0),
        pose: found.pose,
        order: usize::try_from(found.slot).ok(),
    };
    found.into_iter().enumerate().map(candidate).collect()
}
