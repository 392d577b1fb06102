//! What was read in images. A GIN index over the grams of all maps finds those that may match.

use std::collections::{BTreeSet, HashMap};

use async_trait::async_trait;
use sqlx::types::Json;

use super::super::{StoreError, TextCandidate, TextCounts, TextStore};
use super::search::image_id;
use super::{PostgresStore, count, counted, record};
use whereabouts_core::text_search::grams;
use whereabouts_core::{Digest, Image, ImageId, ImageTexts, Map};

/// PostgreSQL has no unsigned numbers; the bits are the same.
fn signed(grams: &BTreeSet<u32>) -> Vec<i32> {
    grams.iter().map(|gram| gram.cast_signed()).collect()
}

#[async_trait]
impl TextStore for PostgresStore {
    async fn put_texts(
        &self,
        map: &Map,
        image: &Image,
        texts: ImageTexts,
    ) -> Result<bool, StoreError> {
        let texts = texts.checked();
        let lines = texts.lines.iter().map(|line| line.text.as_str());
        let query = sqlx::query(
            "INSERT INTO image_texts (map_uid, image, reader, failed, lines, grams, record)
             SELECT map_uid, id, $4, $5, $6, $7, $8::json FROM images
             WHERE map_uid = $1 AND id = $2 AND digest = $3 FOR KEY SHARE
             ON CONFLICT (map_uid, image) DO UPDATE
             SET reader = EXCLUDED.reader, failed = EXCLUDED.failed, lines = EXCLUDED.lines,
                 grams = EXCLUDED.grams, record = EXCLUDED.record",
        )
        .bind(map.uid)
        .bind(image.id.as_str())
        .bind(image.digest.as_bytes().as_slice())
        .bind(texts.reader.as_bytes().as_slice())
        .bind(texts.error.is_some())
        .bind(i32::try_from(texts.lines.len()).unwrap_or(i32::MAX))
        .bind(signed(&grams(lines)))
        .bind(record(&texts)?);
        Ok(self.inner.run(query).await? > 0)
    }

    async fn texts(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<ImageTexts>>, StoreError> {
        let inner = &self.inner;
        let keys: Vec<&str> = ids.iter().map(ImageId::as_str).collect();
        let query = sqlx::query_as(
            "SELECT image, record FROM image_texts WHERE map_uid = $1 AND image = ANY($2)",
        )
        .bind(map.uid)
        .bind(keys);
        let found: Vec<(String, Json<ImageTexts>)> =
            inner.call(async { Ok(query.fetch_all(&inner.pool).await?) }).await?;
        let found: HashMap<String, ImageTexts> =
            found.into_iter().map(|(id, Json(texts))| (id, texts)).collect();
        Ok(ids.iter().map(|id| found.get(id.as_str()).cloned()).collect())
    }

    async fn unread(
        &self,
        map: &Map,
        reader: &Digest,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError> {
        let query = sqlx::query_scalar(
            "SELECT i.record FROM images i
             LEFT JOIN image_texts t ON t.map_uid = i.map_uid AND t.image = i.id
             WHERE i.map_uid = $1 AND i.id > $2 AND t.reader IS DISTINCT FROM $3
             ORDER BY i.id LIMIT $4",
        )
        .bind(map.uid)
        .bind(after.map_or("", ImageId::as_str))
        .bind(reader.as_bytes().as_slice())
        .bind(count(limit));
        self.inner.all(query).await
    }

    async fn text_counts(
        &self,
        map: &Map,
        reader: Option<&Digest>,
    ) -> Result<TextCounts, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query_as(
            "SELECT count(*) FILTER (WHERE NOT failed), count(*) FILTER (WHERE failed),
                 coalesce(sum(lines) FILTER (WHERE NOT failed), 0)::bigint
             FROM image_texts WHERE map_uid = $1 AND ($2::bytea IS NULL OR reader = $2)",
        )
        .bind(map.uid)
        .bind(reader.map(|reader| reader.as_bytes().to_vec()));
        let (read, failed, lines): (i64, i64, i64) =
            inner.call(async { Ok(query.fetch_one(&inner.pool).await?) }).await?;
        Ok(TextCounts { read: counted(read), failed: counted(failed), lines: counted(lines) })
    }

    async fn text_candidates(
        &self,
        map: &Map,
        grams: &BTreeSet<u32>,
        limit: usize,
    ) -> Result<Vec<TextCandidate>, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query_as(
            "SELECT image, shared FROM (
                 SELECT image, (SELECT count(*) FROM unnest(grams) gram WHERE gram = ANY($2)) AS shared
                 FROM image_texts WHERE map_uid = $1 AND grams && $2) found
             ORDER BY shared DESC, image LIMIT $3",
        )
        .bind(map.uid)
        .bind(signed(grams))
        .bind(count(limit));
        let found: Vec<(String, i64)> =
            inner.call(async { Ok(query.fetch_all(&inner.pool).await?) }).await?;
        let candidate = |(id, shared): (String, i64)| {
            Ok(TextCandidate { image: image_id(id)?, shared: counted(shared) })
        };
        found.into_iter().map(candidate).collect()
    }
}
