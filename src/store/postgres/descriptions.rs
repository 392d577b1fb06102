//! The description cache, and the frames whose pairs were described.
//!
//! The cache is bounded in bytes and in age. The least recently used descriptions are evicted first;
//! uses are recorded at most once per [`USE_RESOLUTION_S`].

use async_trait::async_trait;
use jiff::Timestamp;
use parking_lot::Mutex;
use uuid::Uuid;

use super::super::StoreError;
use super::blobs::digest_of;
use super::{Inner, PostgresStore, count, counted, record};
use crate::{DescriptionCache, DescriptionFilter};
use whereabouts_core::{CacheLevels, CachedDescription, DescribedFrame, SimilarFrame};
use whereabouts_core::{Descriptor, Digest, StandIn};

/// Maximum number of similar frames returned. A pair that none of them has is bought.
const MAX_SIMILAR_FRAMES: i64 = 4;

/// A use is recorded only if the last recorded one is older than this, in seconds.
const USE_RESOLUTION_S: f64 = 3600.0;

/// Maximum number of descriptions removed in one statement.
const REMOVAL_BATCH: i64 = 1000;

/// The size of the cache when it was last measured.
#[derive(Default)]
pub(super) struct KnownLevels(Mutex<CacheLevels>);

impl KnownLevels {
    fn get(&self) -> CacheLevels {
        *self.0.lock()
    }

    fn set(&self, levels: CacheLevels) {
        *self.0.lock() = levels;
    }
}

#[async_trait]
impl DescriptionCache for PostgresStore {
    async fn description(&self, key: &Digest) -> Result<Option<CachedDescription>, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query_scalar(
            "WITH used AS (
                 UPDATE descriptions SET used_at = now()
                 WHERE key = $1 AND used_at < now() - make_interval(secs => $3))
             SELECT record FROM descriptions
             WHERE key = $1 AND created_at > now() - make_interval(secs => $2)",
        )
        .bind(key.as_bytes().as_slice())
        .bind(inner.settings.descriptions.max_age.as_secs_f64())
        .bind(USE_RESOLUTION_S);
        inner.one(query).await
    }

    async fn keep_description(
        &self,
        key: Digest,
        value: CachedDescription,
    ) -> Result<(), StoreError> {
        let inner = &self.inner;
        let text = record(&value)?;
        let query = sqlx::query(
            "WITH bought AS (DELETE FROM purchases WHERE key = $1)
             INSERT INTO descriptions (key, size, created_at, used_at, record)
             VALUES ($1, $2, now(), now(), $3::json)
             ON CONFLICT (key) DO UPDATE SET size = EXCLUDED.size, created_at = now(),
                 used_at = now(), record = EXCLUDED.record",
        )
        .bind(key.as_bytes().as_slice())
        .bind(count(text.len() + key.as_bytes().len()))
        .bind(text);
        inner.run(query).await.map(drop)
    }

    async fn descriptions(
        &self,
        filter: &DescriptionFilter,
        after: Option<&Digest>,
        limit: usize,
    ) -> Result<Vec<(Digest, CachedDescription)>, StoreError> {
        let inner = &self.inner;
        let mut found = Vec::new();
        let mut after = after.map(|after| after.as_bytes().to_vec()).unwrap_or_default();
        loop {
            let query = sqlx::query_as(
                "SELECT key, record FROM descriptions WHERE key > $1 ORDER BY key LIMIT $2",
            )
            .bind(after.clone())
            .bind(REMOVAL_BATCH);
            let page: Vec<(Vec<u8>, sqlx::types::Json<CachedDescription>)> =
                inner.call(async { Ok(query.fetch_all(&inner.pool).await?) }).await?;
            let Some((last, _)) = page.last() else { return Ok(found) };
            after = last.clone();
            for (key, record) in page {
                if filter.matches(&record.0) {
                    found.push((digest_of(&key)?, record.0));
                }
                if found.len() >= limit {
                    return Ok(found);
                }
            }
        }
    }

    async fn remove_descriptions(&self, keys: &[Digest]) -> Result<usize, StoreError> {
        let keys: Vec<Vec<u8>> = keys.iter().map(|key| key.as_bytes().to_vec()).collect();
        let query = sqlx::query("DELETE FROM descriptions WHERE key = ANY($1)").bind(keys);
        let removed = self.inner.run(query).await?;
        Ok(usize::try_from(removed).unwrap_or(usize::MAX))
    }

    async fn acquire_lease(&self, key: &Digest, until: Timestamp) -> Result<bool, StoreError> {
        let inner = &self.inner;
        let for_s = until.duration_since(Timestamp::now()).as_secs_f64().max(0.0);
        let query = sqlx::query(
            "INSERT INTO purchases (key, holder, until)
             VALUES ($1, $2, now() + make_interval(secs => $3))
             ON CONFLICT (key) DO UPDATE SET holder = EXCLUDED.holder, until = EXCLUDED.until
             WHERE purchases.holder = $2 OR purchases.until <= now()
                 OR NOT is_alive(purchases.holder, make_interval(secs => $4))",
        )
        .bind(key.as_bytes().as_slice())
        .bind(inner.process)
        .bind(for_s)
        .bind(inner.lifetime());
        Ok(inner.run(query).await? > 0)
    }

    async fn release_lease(&self, key: &Digest) -> Result<(), StoreError> {
        let inner = &self.inner;
        let query = sqlx::query("DELETE FROM purchases WHERE key = $1 AND holder = $2")
            .bind(key.as_bytes().as_slice())
            .bind(inner.process);
        inner.run(query).await.map(drop)
    }

    async fn similar_frames(
        &self,
        map: Uuid,
        to: &Descriptor,
        at_least: f32,
    ) -> Result<Vec<SimilarFrame>, StoreError> {
        let inner = &self.inner;
        // A map whose model changed while it was empty still has frames of the old model.
        let query = sqlx::query_as(
            "SELECT query_id, digest, similarity FROM (
                 SELECT query_id, digest, 1 - (descriptor <=> $2::real[]::vector) AS similarity
                 FROM (SELECT * FROM frames WHERE map_uid = $1 AND vector_dims(descriptor) = $3
                       OFFSET 0) alike) compared
             WHERE similarity >= $4 ORDER BY similarity DESC LIMIT $5",
        )
        .bind(map)
        .bind(to.as_slice())
        .bind(i32::try_from(to.dim()).unwrap_or(0))
        .bind(f64::from(at_least))
        .bind(MAX_SIMILAR_FRAMES);
        inner
            .call(async {
                let found: Vec<(Uuid, Vec<u8>, f64)> = query.fetch_all(&inner.pool).await?;
                let similar = |(query_id, digest, similarity): (Uuid, Vec<u8>, f64)| {
                    let stand_in = StandIn { query_id, similarity: similarity as f32 };
                    Ok(SimilarFrame { digest: digest_of(&digest)?, stand_in })
                };
                found.into_iter().map(similar).collect()
            })
            .await
    }

    async fn keep_frame(
        &self,
        map: Uuid,
        frame: DescribedFrame,
        max_frames: usize,
    ) -> Result<(), StoreError> {
        let inner = &self.inner;
        let keep = sqlx::query(
            "INSERT INTO frames (map_uid, query_id, digest, descriptor)
             VALUES ($1, $2, $3, $4::real[]::vector) ON CONFLICT DO NOTHING",
        )
        .bind(map)
        .bind(frame.query_id)
        .bind(frame.digest.as_bytes().as_slice())
        .bind(frame.descriptor.as_slice());
        // Ids sort by age.
        let forget = sqlx::query(
            "DELETE FROM frames WHERE map_uid = $1 AND query_id <= (
                 SELECT query_id FROM frames WHERE map_uid = $1
                 ORDER BY query_id DESC OFFSET $2 LIMIT 1)",
        )
        .bind(map)
        .bind(count(max_frames));
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                keep.execute(&mut *tx).await?;
                forget.execute(&mut *tx).await?;
                Ok(tx.commit().await?)
            })
            .await
    }

    fn levels(&self) -> CacheLevels {
        self.inner.levels.get()
    }
}

impl Inner {
    /// Removes expired leases and descriptions, evicts descriptions beyond the bound, and measures the
    /// cache.
    pub(super) async fn evict_descriptions(&self) -> Result<(), StoreError> {
        let bounds = self.settings.descriptions;
        let expired_leases = sqlx::query("DELETE FROM purchases WHERE until <= now()");
        self.run(expired_leases).await?;
        loop {
            let expired = sqlx::query(
                "DELETE FROM descriptions WHERE key IN (
                     SELECT key FROM descriptions
                     WHERE created_at <= now() - make_interval(secs => $1) LIMIT $2)",
            )
            .bind(bounds.max_age.as_secs_f64())
            .bind(REMOVAL_BATCH);
            let removed = self.run(expired).await?;
            if removed < REMOVAL_BATCH.unsigned_abs() {
                break;
            }
        }
        loop {
            let levels = self.call(self.cache_levels()).await?;
            self.levels.set(levels);
            let excess = levels.bytes.saturating_sub(bounds.max_bytes);
            if excess == 0 {
                return Ok(());
            }
            // The least recently used ones, until the excess is freed.
            let least_used = sqlx::query(
                "DELETE FROM descriptions WHERE key IN (
                     SELECT key FROM (
                         SELECT key, sum(size) OVER (ORDER BY used_at, key) - size AS before
                         FROM (SELECT key, size, used_at FROM descriptions
                               ORDER BY used_at, key LIMIT $2) oldest) summed
                     WHERE before < $1)",
            )
            .bind(i64::try_from(excess).unwrap_or(i64::MAX))
            .bind(REMOVAL_BATCH);
            let evicted = self.run(least_used).await?;
            if evicted == 0 {
                return Ok(());
            }
        }
    }

    async fn cache_levels(&self) -> Result<CacheLevels, StoreError> {
        let query = "SELECT count(*), coalesce(sum(size), 0)::bigint FROM descriptions";
        let (entries, bytes): (i64, i64) = sqlx::query_as(query).fetch_one(&self.pool).await?;
        Ok(CacheLevels { entries: counted(entries), bytes: bytes.unsigned_abs() })
    }
}
