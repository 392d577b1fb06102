//! The images of maps. A single statement adds an image together with its descriptor, the count of
//! images and the reference to its bytes, and another removes all of them.

use std::collections::HashMap;

use async_trait::async_trait;
use jiff::Timestamp;
use sqlx::AssertSqlSafe;
use sqlx::Row;
use sqlx::types::Json;
use uuid::Uuid;

use super::super::changes::{check_frame, in_order, removed, same_bytes};
use super::super::{Added, ExportStore, LocatedImage, StoreError};
use super::descriptors::{descriptor_of, table};
use super::search::image_id;
use super::{Inner, PostgresStore, blobs, count, is_missing_table, record};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Descriptor, Image, ImageId, ImageTexts, Map, Pose, Recording};

/// Number of rows that a map's counts are spread over, to reduce contention.
const COUNT_PARTS: i16 = 16;

/// Maximum number of attempts when concurrent changes interfere.
const MAX_ATTEMPTS: usize = 3;

impl Inner {
    pub(super) async fn add_image(
        &self,
        map: &Map,
        image: Image,
        descriptor: &Descriptor,
        recording: Option<Recording>,
    ) -> Result<Added, StoreError> {
        let table = table(map.uid, map.revision);
        let sql = format!(
            "WITH map AS (
                 SELECT uid, record FROM maps WHERE uid = $1 AND revision = $2 FOR SHARE),
             added AS (
                 INSERT INTO images (map_uid, id, digest, record, pose, recording, number)
                 SELECT uid, $3, $4, $5::json, $8::json, $9, $10 FROM map
                 ON CONFLICT DO NOTHING RETURNING slot),
             described AS (
                 INSERT INTO {table} (slot, descriptor) SELECT slot, $6::real[]::vector FROM added),
             counted AS (
                 INSERT INTO image_counts (map_uid, part, images, changes, located)
                 SELECT $1, $7, 1, 1, ($8::json IS NOT NULL)::int FROM added
                 ON CONFLICT (map_uid, part) DO UPDATE
                 SET images = image_counts.images + 1, changes = image_counts.changes + 1,
                     located = image_counts.located + EXCLUDED.located),
             needed AS (
                 UPDATE blobs SET needed = needed + 1
                 WHERE digest = $4 AND EXISTS (SELECT FROM added) RETURNING digest)
             SELECT (SELECT count(*) FROM added) AS added, (SELECT count(*) FROM needed) AS needed,
                 (SELECT record FROM map) AS map"
        );
        let (text, pose) = (record(&image)?, image.pose.as_ref().map(record).transpose()?);
        for _ in 0..MAX_ATTEMPTS {
            // A transaction, so that an image whose bytes are missing is rolled back.
            let mut tx = self.begin().await?;
            let added = sqlx::query(AssertSqlSafe(sql.clone()))
                .bind(map.uid)
                .bind(i64::from(map.revision))
                .bind(image.id.as_str())
                .bind(image.digest.as_bytes().as_slice())
                .bind(&text)
                .bind(descriptor.as_slice())
                .bind(part())
                .bind(&pose)
                .bind(recording.map(|recording| recording.id))
                .bind(recording.map(|recording| i64::from(recording.number)))
                .fetch_one(&mut *tx)
                .await;
            let row = match added {
                Ok(row) => row,
                Err(error) => {
                    drop(tx);
                    return Err(self.explain(map, error).await);
                }
            };
            match (row.try_get::<i64, _>("added")?, row.try_get::<i64, _>("needed")?) {
                (0, _) => {}
                (_, 0) => return Err(blobs::not_stored(&image.digest)),
                _ => {
                    let stored: Option<Json<Map>> = row.try_get("map")?;
                    check_frame(stored.as_deref().unwrap_or(map), &image)?;
                    tx.commit().await?;
                    return Ok(Added::Created(image));
                }
            }
            drop(tx);
            self.check_revision(map).await?;
            if let Some(present) = self.image(map.uid, &image.id).await? {
                return Ok(Added::Present(same_bytes(present, &image)?));
            }
            // The image existed and was removed just now, so try again.
        }
        Err(super::unavailable("other processes are changing the same image"))
    }

    pub(super) async fn replace_image(
        &self,
        map: &Map,
        current: &Image,
        next: &Image,
    ) -> Result<bool, StoreError> {
        let mut tx = self.begin().await?;
        // A change of the coordinate frame waits.
        let stored = sqlx::query_scalar("SELECT record FROM maps WHERE uid = $1 FOR SHARE");
        let stored: Option<Json<Map>> = stored.bind(map.uid).fetch_optional(&mut *tx).await?;
        let Json(stored) = stored.ok_or_else(|| removed(map))?;
        check_frame(&stored, next)?;
        let image = sqlx::query_scalar(
            "SELECT record FROM images WHERE map_uid = $1 AND id = $2 FOR UPDATE",
        );
        let image: Option<Json<Image>> =
            image.bind(map.uid).bind(current.id.as_str()).fetch_optional(&mut *tx).await?;
        if image.is_none_or(|Json(image)| image != *current) {
            return Ok(false);
        }
        sqlx::query(
            "UPDATE images SET record = $3::json, pose = $4::json WHERE map_uid = $1 AND id = $2",
        )
        .bind(map.uid)
        .bind(current.id.as_str())
        .bind(record(next)?)
        .bind(next.pose.as_ref().map(record).transpose()?)
        .execute(&mut *tx)
        .await?;
        if current.pose != next.pose {
            sqlx::query(
                "INSERT INTO image_counts (map_uid, part, images, changes, moved, located)
                 VALUES ($1, $2, 0, 1, 1, 1) ON CONFLICT (map_uid, part) DO UPDATE
                 SET changes = image_counts.changes + 1, moved = image_counts.moved + 1,
                     located = image_counts.located + 1",
            )
            .bind(map.uid)
            .bind(part())
            .execute(&mut *tx)
            .await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    pub(super) async fn image(
        &self,
        map_uid: Uuid,
        id: &ImageId,
    ) -> Result<Option<Image>, StoreError> {
        let found = sqlx::query_scalar("SELECT record FROM images WHERE map_uid = $1 AND id = $2");
        let found: Option<Json<Image>> =
            found.bind(map_uid).bind(id.as_str()).fetch_optional(&self.pool).await?;
        Ok(found.map(|Json(image)| image))
    }

    pub(super) async fn images_by_id(
        &self,
        map_uid: Uuid,
        ids: &[ImageId],
    ) -> Result<Vec<Option<Image>>, StoreError> {
        let keys: Vec<&str> = ids.iter().map(ImageId::as_str).collect();
        let found: Vec<Json<Image>> =
            sqlx::query_scalar("SELECT record FROM images WHERE map_uid = $1 AND id = ANY($2)")
                .bind(map_uid)
                .bind(keys)
                .fetch_all(&self.pool)
                .await?;
        let found: HashMap<ImageId, Image> =
            found.into_iter().map(|Json(image)| (image.id.clone(), image)).collect();
        Ok(ids.iter().map(|id| found.get(id).cloned()).collect())
    }

    pub(super) async fn slots_of(
        &self,
        map_uid: Uuid,
        ids: &[ImageId],
    ) -> Result<Vec<Option<usize>>, StoreError> {
        let keys: Vec<&str> = ids.iter().map(ImageId::as_str).collect();
        let found: Vec<(String, i64)> =
            sqlx::query_as("SELECT id, slot FROM images WHERE map_uid = $1 AND id = ANY($2)")
                .bind(map_uid)
                .bind(keys)
                .fetch_all(&self.pool)
                .await?;
        let found: HashMap<String, i64> = found.into_iter().collect();
        let slot =
            |id: &ImageId| found.get(id.as_str()).and_then(|&slot| usize::try_from(slot).ok());
        Ok(ids.iter().map(slot).collect())
    }

    pub(super) async fn images(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError> {
        let images: Vec<Json<Image>> = sqlx::query_scalar(
            "SELECT record FROM images WHERE map_uid = $1 AND id > $2 ORDER BY id LIMIT $3",
        )
        .bind(map.uid)
        .bind(after.map_or("", ImageId::as_str))
        .bind(count(limit))
        .fetch_all(&self.pool)
        .await?;
        Ok(images.into_iter().map(|Json(image)| image).collect())
    }

    pub(super) async fn positions(&self, map: &Map) -> Result<Vec<LocatedImage>, StoreError> {
        let positions: Vec<LocatedRow> = sqlx::query_as(
            "SELECT i.slot, i.id, i.pose, i.recording, i.number
             FROM images i JOIN maps m ON m.uid = i.map_uid
             WHERE i.map_uid = $1 AND i.pose IS NOT NULL ORDER BY i.slot",
        )
        .bind(map.uid)
        .fetch_all(&self.pool)
        .await?;
        if positions.is_empty() {
            self.check_exists(map).await?;
        }
        let located = positions.into_iter().map(|(slot, id, Json(pose), recording, number)| {
            let image = LocatedImage { slot: slot as usize, id: image_id(id)?, pose };
            Ok((image, in_recording(recording, number)))
        });
        Ok(in_order(located.collect::<Result<_, StoreError>>()?))
    }

    pub(super) async fn delete_image(&self, map: &Map, id: &ImageId) -> Result<bool, StoreError> {
        for _ in 0..MAX_ATTEMPTS {
            let revision = sqlx::query_scalar("SELECT revision FROM maps WHERE uid = $1");
            let revision: Option<i64> = revision.bind(map.uid).fetch_optional(&self.pool).await?;
            let revision = revision.ok_or_else(|| removed(map))?;
            let table = table(map.uid, u32::try_from(revision).unwrap_or_default());
            let sql = format!(
                "WITH map AS (
                     SELECT uid FROM maps WHERE uid = $1 AND revision = $2 FOR SHARE),
                 gone AS (
                     DELETE FROM images USING map WHERE map_uid = map.uid AND id = $3
                     RETURNING slot, digest, pose IS NOT NULL AS is_located),
                 described AS (DELETE FROM {table} WHERE slot IN (SELECT slot FROM gone)),
                 counted AS (
                     INSERT INTO image_counts (map_uid, part, images, changes, located)
                     SELECT $1, $4, -1, 1, is_located::int FROM gone
                     ON CONFLICT (map_uid, part) DO UPDATE
                     SET images = image_counts.images - 1, changes = image_counts.changes + 1,
                         located = image_counts.located + EXCLUDED.located),
                 needed AS (
                     UPDATE blobs b SET needed = b.needed - 1 FROM gone WHERE b.digest = gone.digest)
                 SELECT (SELECT count(*) FROM gone) AS gone, (SELECT count(*) FROM map) AS map"
            );
            let deleted = sqlx::query(AssertSqlSafe(sql))
                .bind(map.uid)
                .bind(revision)
                .bind(id.as_str())
                .bind(part())
                .fetch_one(&self.pool)
                .await;
            match deleted {
                Ok(row) if row.try_get::<i64, _>("map")? > 0 => {
                    return Ok(row.try_get::<i64, _>("gone")? > 0);
                }
                // The map was reindexed meanwhile, so try again.
                Ok(_) => {}
                Err(error) if is_missing_table(&error) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Err(super::unavailable("the map is being reindexed"))
    }
}

#[async_trait]
impl ExportStore for PostgresStore {
    async fn export(
        &self,
        map: &Map,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<ExportedImage>, StoreError> {
        let inner = &self.inner;
        let table = table(map.uid, map.revision);
        let sql = format!(
            "SELECT i.record, d.descriptor::real[], i.slot, i.recording, i.number, t.record FROM images i
             JOIN maps m ON m.uid = i.map_uid AND m.revision = $4
             LEFT JOIN {table} d ON d.slot = i.slot
             LEFT JOIN image_texts t ON t.map_uid = i.map_uid AND t.image = i.id
             WHERE i.map_uid = $1 AND i.id > $2 ORDER BY i.id LIMIT $3"
        );
        let query = sqlx::query_as(AssertSqlSafe(sql))
            .bind(map.uid)
            .bind(after.map_or("", ImageId::as_str))
            .bind(count(limit))
            .bind(i64::from(map.revision));
        inner
            .call(async {
                let found: Vec<ExportedRow> = match query.fetch_all(&inner.pool).await {
                    Ok(found) => found,
                    Err(error) => return Err(inner.explain(map, error).await),
                };
                if found.is_empty() {
                    inner.check_revision(map).await?;
                }
                let exported =
                    |(Json(image), numbers, slot, recording, number, texts): ExportedRow| {
                        let descriptor = numbers.and_then(descriptor_of);
                        let recording = in_recording(recording, number);
                        ExportedImage {
                            image,
                            descriptor,
                            position: u64::try_from(slot).ok(),
                            recording,
                            texts: texts.map(|Json(texts)| texts),
                        }
                    };
                Ok(found.into_iter().map(exported).collect())
            })
            .await
    }
}

/// The slot of an image, its id, its pose, and its place in a recording.
type LocatedRow = (i64, String, Json<Pose>, Option<Uuid>, Option<i64>);

/// An image, its descriptor, its slot, its place in a recording, and its texts.
type ExportedRow =
    (Json<Image>, Option<Vec<f32>>, i64, Option<Uuid>, Option<i64>, Option<Json<ImageTexts>>);

/// The place in a recording that is in the columns of an image.
fn in_recording(id: Option<Uuid>, number: Option<i64>) -> Option<Recording> {
    Some(Recording { id: id?, number: u32::try_from(number?).ok()? })
}

/// Chooses an arbitrary row of a map's counts.
fn part() -> i16 {
    (Timestamp::now().subsec_nanosecond() / 1000 % i32::from(COUNT_PARTS)) as i16
}
