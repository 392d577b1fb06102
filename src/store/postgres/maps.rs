//! Maps.

use std::sync::Arc;

use async_trait::async_trait;
use sqlx::types::Json;
use sqlx::{PgConnection, Row};
use uuid::Uuid;

use super::super::changes::{MapContent, changed_map, check_dim, removed};
use super::super::{Added, HardNegatives, IndexState, LocatedImage, MapStore, StoreError};
use super::descriptors::create_table;
use super::{Inner, PostgresStore, counted, record};
use whereabouts_core::{
    Calibration, CalibrationSettings, Candidate, Descriptor, Image, ImageId, Map, MapName,
    Recording,
};
use whereabouts_index::SearchMode;

#[async_trait]
impl MapStore for PostgresStore {
    async fn put_map(&self, map: Map) -> Result<(Map, bool), StoreError> {
        self.inner.call(self.inner.put_map(map)).await
    }

    async fn map(&self, name: &MapName) -> Result<Option<Map>, StoreError> {
        let query = sqlx::query_scalar("SELECT record FROM maps WHERE name = $1");
        self.inner.one(query.bind(name.as_str())).await
    }

    async fn maps(&self) -> Result<Vec<Map>, StoreError> {
        self.inner.all(sqlx::query_scalar("SELECT record FROM maps ORDER BY name")).await
    }

    async fn delete_map(&self, name: &MapName) -> Result<bool, StoreError> {
        let inner = &self.inner;
        let Some(uid) = inner.call(inner.delete_map(name)).await? else { return Ok(false) };
        inner.graphs.forget(uid);
        inner.drop_unused_tables_of(uid).await;
        // Callers no longer see the map; its images are now removed in small batches. If this process
        // ends before that is done, garbage collection finishes it.
        while inner.call(inner.sweep(uid)).await? {}
        Ok(true)
    }

    async fn index_state(&self, map: &Map) -> Result<IndexState, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query(
            "SELECT coalesce(m.indexed_revision = m.revision, false) AS graph,
                 coalesce(sum(c.images), 0)::bigint AS images,
                 coalesce(sum(c.changes), 0)::bigint AS changes,
                 coalesce(sum(c.moved), 0)::bigint AS moved,
                 coalesce(sum(c.located), 0)::bigint AS located
             FROM maps m LEFT JOIN image_counts c ON c.map_uid = m.uid
             WHERE m.uid = $1 GROUP BY m.uid",
        )
        .bind(map.uid);
        inner
            .call(async {
                let row = query.fetch_optional(&inner.pool).await?.ok_or_else(|| removed(map))?;
                Ok(IndexState {
                    images: counted(row.try_get("images")?),
                    graph: row.try_get("graph")?,
                    // PostgreSQL's index contains every image as soon as it is stored.
                    behind: false,
                    changes: row.try_get::<i64, _>("changes")?.unsigned_abs(),
                    moved: row.try_get::<i64, _>("moved")?.unsigned_abs(),
                    located: row.try_get::<i64, _>("located")?.unsigned_abs(),
                })
            })
            .await
    }

    async fn add_recorded(
        &self,
        map: &Map,
        image: Image,
        descriptor: Descriptor,
        recording: Option<Recording>,
    ) -> Result<Added, StoreError> {
        self.inner.call(self.inner.add_image(map, image, &descriptor, recording)).await
    }

    async fn replace_image(
        &self,
        map: &Map,
        current: &Image,
        next: Image,
    ) -> Result<bool, StoreError> {
        self.inner.call(self.inner.replace_image(map, current, &next)).await
    }

    async fn image(&self, map: &Map, id: &ImageId) -> Result<Option<Image>, StoreError> {
        self.inner.call(self.inner.image(map.uid, id)).await
    }

    async fn images_by_id(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<Image>>, StoreError> {
        self.inner.call(self.inner.images_by_id(map.uid, ids)).await
    }

    async fn slots(&self, map: &Map, ids: &[ImageId]) -> Result<Vec<Option<usize>>, StoreError> {
        self.inner.call(self.inner.slots_of(map.uid, ids)).await
    }

    async fn images(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError> {
        self.inner.call(self.inner.images(map, after, limit)).await
    }

    async fn positions(&self, map: &Map) -> Result<Vec<LocatedImage>, StoreError> {
        self.inner.call(self.inner.positions(map)).await
    }

    async fn delete_image(&self, map: &Map, id: &ImageId) -> Result<bool, StoreError> {
        self.inner.call(self.inner.delete_image(map, id)).await
    }

    async fn search(
        &self,
        map: &Map,
        query: Descriptor,
        k: usize,
        mode: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError> {
        check_dim(map, &query)?;
        self.inner.call(self.inner.candidates(map, &query, k, mode)).await
    }

    async fn descriptors(
        &self,
        map: &Map,
        slots: Vec<usize>,
    ) -> Result<Vec<Option<Descriptor>>, StoreError> {
        self.inner.call(self.inner.descriptors_in(map, &slots)).await
    }

    async fn similarities(
        &self,
        map: &Map,
        vector: Vec<f32>,
        slots: Vec<usize>,
    ) -> Result<Vec<Option<f32>>, StoreError> {
        self.inner.call(self.inner.similarities_to(map, &vector, &slots)).await
    }

    async fn hard_negatives(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Vec<HardNegatives>, StoreError> {
        let inner = &self.inner;
        inner.call(inner.acquire_calibration(map)).await?;
        // Not subject to the time limit of a call: these are many searches.
        inner.find_hard_negatives(map, settings, k).await
    }

    async fn calibration(&self, map: &Map) -> Result<Option<Arc<Calibration>>, StoreError> {
        let inner = &self.inner;
        let query =
            sqlx::query_scalar("SELECT calibration FROM maps WHERE uid = $1 AND revision = $2")
                .bind(map.uid)
                .bind(i64::from(map.revision));
        inner
            .call(async {
                let found: Option<Option<Json<Calibration>>> =
                    query.fetch_optional(&inner.pool).await?;
                Ok(found.flatten().map(|Json(measured)| Arc::new(measured)))
            })
            .await
    }

    async fn put_calibration(&self, map: &Map, measured: Calibration) -> Result<(), StoreError> {
        let inner = &self.inner;
        let sql = "UPDATE maps SET calibration = $3::json WHERE uid = $1 AND revision = $2";
        let query =
            sqlx::query(sql).bind(map.uid).bind(i64::from(map.revision)).bind(record(&measured)?);
        inner
            .call(async {
                match query.execute(&inner.pool).await?.rows_affected() {
                    0 => inner.check_revision(map).await,
                    _ => Ok(()),
                }
            })
            .await
    }
}

impl Inner {
    async fn put_map(&self, requested: Map) -> Result<(Map, bool), StoreError> {
        loop {
            if let Some(put) = self.try_to_put_map(requested.clone()).await? {
                return Ok(put);
            }
        }
    }

    /// Returns `None` if a concurrent call has just created the map, so that it must be read again.
    async fn try_to_put_map(&self, requested: Map) -> Result<Option<(Map, bool)>, StoreError> {
        let mut tx = self.begin().await?;
        let stored = sqlx::query_scalar("SELECT record FROM maps WHERE name = $1 FOR UPDATE");
        let stored = stored.bind(requested.name.as_str()).fetch_optional(&mut *tx).await?;
        let (map, new) = match stored {
            None => {
                let inserted = sqlx::query(
                    "INSERT INTO maps (uid, name, revision, record, vocabulary)
                     VALUES ($1, $2, $3, $4::json, $5) ON CONFLICT (name) DO NOTHING",
                )
                .bind(requested.uid)
                .bind(requested.name.as_str())
                .bind(i64::from(requested.revision))
                .bind(record(&requested)?)
                .bind(vocabulary(&requested))
                .execute(&mut *tx)
                .await?;
                if inserted.rows_affected() == 0 {
                    return Ok(None);
                }
                create_table(&mut tx, &requested).await?;
                (requested, true)
            }
            Some(Json(stored)) => {
                let stored: Map = stored;
                let before = stored.uid;
                let reframed = stored.frame != requested.frame;
                let content = content(&mut tx, before, reframed).await?;
                let map = changed_map(stored, requested, || Ok(content))?;
                if map.uid != before {
                    add_tombstone(&mut tx, before).await?;
                    create_table(&mut tx, &map).await?;
                }
                let changed = sqlx::query(
                    "UPDATE maps SET uid = $2, record = $3::json, vocabulary = $4,
                         graph = graph AND uid = $2,
                         indexed_revision = CASE WHEN uid = $2 THEN indexed_revision END,
                         calibration = CASE WHEN uid = $2 THEN calibration END
                     WHERE uid = $1",
                );
                changed
                    .bind(before)
                    .bind(map.uid)
                    .bind(record(&map)?)
                    .bind(vocabulary(&map))
                    .execute(&mut *tx)
                    .await?;
                (map, false)
            }
        };
        tx.commit().await?;
        Ok(Some((map, new)))
    }

    async fn delete_map(&self, name: &MapName) -> Result<Option<Uuid>, StoreError> {
        let mut tx = self.begin().await?;
        let deleted = sqlx::query_scalar("DELETE FROM maps WHERE name = $1 RETURNING uid");
        let deleted: Option<Uuid> = deleted.bind(name.as_str()).fetch_optional(&mut *tx).await?;
        let Some(uid) = deleted else { return Ok(None) };
        add_tombstone(&mut tx, uid).await?;
        tx.commit().await?;
        Ok(Some(uid))
    }

    /// Acquires the right of this process to calibrate the map.
    async fn acquire_calibration(&self, map: &Map) -> Result<(), StoreError> {
        let acquired = sqlx::query(
            "UPDATE maps SET measured_by = $3 WHERE uid = $1 AND revision = $2
                 AND (measured_by IS NULL OR measured_by = $3
                     OR NOT is_alive(measured_by, make_interval(secs => $4)))",
        )
        .bind(map.uid)
        .bind(i64::from(map.revision))
        .bind(self.process)
        .bind(self.lifetime())
        .execute(&self.pool)
        .await?;
        if acquired.rows_affected() == 0 {
            self.check_revision(map).await?;
            let name = &map.name;
            return Err(StoreError::Conflict(format!(
                "another process is calibrating the map {name}"
            )));
        }
        Ok(())
    }

    /// Removes a batch of the images of a deleted map; once there are none, the rest of its rows and its
    /// tombstone. Returns `false` when nothing is left.
    async fn sweep(&self, uid: Uuid) -> Result<bool, StoreError> {
        let mut tx = self.begin().await?;
        let removed: i64 = sqlx::query_scalar(
            "WITH gone AS (
                 DELETE FROM images WHERE map_uid = $1 AND id IN (
                     SELECT id FROM images WHERE map_uid = $1 ORDER BY id LIMIT 256
                     FOR UPDATE SKIP LOCKED)
                 RETURNING digest),
             needed AS (
                 UPDATE blobs b SET needed = b.needed - g.images
                 FROM (SELECT digest, count(*) AS images FROM gone GROUP BY digest) g
                 WHERE b.digest = g.digest)
             SELECT count(*) FROM gone",
        )
        .bind(uid)
        .fetch_one(&mut *tx)
        .await?;
        if removed == 0 {
            for rest in [
                "DELETE FROM frames WHERE map_uid = $1",
                "DELETE FROM image_counts WHERE map_uid = $1",
                "DELETE FROM tracks WHERE map_uid = $1",
                "DELETE FROM deleted_maps WHERE uid = $1",
            ] {
                sqlx::query(rest).bind(uid).execute(&mut *tx).await?;
            }
        }
        tx.commit().await?;
        Ok(removed > 0)
    }

    /// Removes orphans: drafts of dead processes, unused tables, and the rows of deleted maps.
    pub(super) async fn collect_orphans(&self) -> Result<(), StoreError> {
        let abandoned_drafts = sqlx::query(
            "DELETE FROM drafts
             WHERE holder <> $1 AND NOT is_alive(holder, make_interval(secs => $2))",
        )
        .bind(self.process)
        .bind(self.lifetime());
        self.run(abandoned_drafts).await?;
        self.drop_unused_tables(None).await?;
        let deleted = sqlx::query_scalar("SELECT uid FROM deleted_maps");
        let deleted: Vec<Uuid> =
            self.call(async { Ok(deleted.fetch_all(&self.pool).await?) }).await?;
        for uid in deleted {
            while self.call(self.sweep(uid)).await? {}
        }
        Ok(())
    }
}

/// The digest of the map's own vocabulary, if it has one.
pub(super) fn vocabulary(map: &Map) -> Option<Vec<u8>> {
    map.vocabulary.map(|own| own.digest.as_bytes().to_vec())
}

/// Adds the tombstone of a deleted map, so that its remaining rows are removed.
async fn add_tombstone(connection: &mut PgConnection, uid: Uuid) -> Result<(), StoreError> {
    let insert = sqlx::query("INSERT INTO deleted_maps (uid) VALUES ($1) ON CONFLICT DO NOTHING");
    insert.bind(uid).execute(connection).await?;
    Ok(())
}

/// Returns what a map contains. Poses are looked for only if `poses` says so, as all images may have to be read.
async fn content(
    connection: &mut PgConnection,
    uid: Uuid,
    poses: bool,
) -> Result<MapContent, StoreError> {
    let content = sqlx::query_as(
        "SELECT EXISTS (SELECT FROM images WHERE map_uid = $1),
             $2 AND EXISTS (SELECT FROM images WHERE map_uid = $1 AND pose IS NOT NULL)",
    );
    Ok(match content.bind(uid).bind(poses).fetch_one(connection).await? {
        (false, _) => MapContent::Empty,
        (true, false) => MapContent::WithoutPoses,
        (true, true) => MapContent::WithPoses,
    })
}
