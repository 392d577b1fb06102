//! Descriptors made anew, in a table beside the one that serves, and the step that puts it in its place.

use async_trait::async_trait;
use sqlx::types::Json;
use sqlx::{AssertSqlSafe, PgConnection};

use super::super::changes::{being_reindexed, removed};
use super::super::{Draft, DraftStore, StoreError};
use super::descriptors::{MOST_INDEXED, drop_table, make_table, table};
use super::{Inner, PostgresStore, count, record};
use whereabouts_core::{Descriptor, Image, Map};

struct PostgresDraft {
    store: PostgresStore,
    /// The map that serves.
    old: Map,
    /// The map as it will be.
    next: Map,
    /// Images up to this place have been looked at.
    seen: i64,
    /// Whether the index was built.
    indexed: bool,
}

#[async_trait]
impl DraftStore for PostgresStore {
    async fn draft(&self, next: Map) -> Result<Box<dyn Draft>, StoreError> {
        let old = Map { revision: next.revision.saturating_sub(1), ..next.clone() };
        let inner = &self.inner;
        inner
            .call(async {
                inner.check_revision(&old).await?;
                let mut tx = inner.begin().await?;
                let taken = sqlx::query(
                    "INSERT INTO drafts (map_uid, revision, holder) VALUES ($1, $2, $3)
                     ON CONFLICT (map_uid) DO UPDATE
                     SET revision = EXCLUDED.revision, holder = EXCLUDED.holder
                     WHERE drafts.holder <> $3
                         AND NOT is_alive(drafts.holder, make_interval(secs => $4))",
                )
                .bind(next.uid)
                .bind(i64::from(next.revision))
                .bind(inner.process)
                .bind(inner.lifetime())
                .execute(&mut *tx)
                .await?;
                if taken.rows_affected() == 0 {
                    return Err(being_reindexed(&next));
                }
                // What a process that is dead may have left.
                drop_table(&mut tx, next.uid, next.revision).await?;
                make_table(&mut tx, &next).await?;
                Ok(tx.commit().await?)
            })
            .await?;
        Ok(Box::new(PostgresDraft { store: self.clone(), old, next, seen: 0, indexed: false }))
    }
}

#[async_trait]
impl Draft for PostgresDraft {
    async fn missing(&mut self, limit: usize) -> Result<Vec<Image>, StoreError> {
        let inner = self.store.inner.clone();
        inner
            .call(async {
                inner.check_revision(&self.old).await?;
                self.check_held(&inner.pool).await?;
                loop {
                    let from = self.seen;
                    let some = self.missing_after(&inner, from, limit).await?;
                    if let Some((last, _)) = some.last() {
                        self.seen = *last;
                        return Ok(some.into_iter().map(|(_, Json(image))| image).collect());
                    }
                    if from == 0 {
                        return Ok(Vec::new());
                    }
                    // Once more from the beginning: places are given before images are stored.
                    self.seen = 0;
                }
            })
            .await
    }

    async fn write(&mut self, image: &Image, descriptor: Descriptor) -> Result<(), StoreError> {
        let inner = &self.store.inner;
        let table = table(self.next.uid, self.next.revision);
        // Its id may have gone to another image, which a later look finds.
        let sql = format!(
            "INSERT INTO {table} (slot, descriptor)
             SELECT slot, $4::real[]::vector FROM images
             WHERE map_uid = $1 AND id = $2 AND digest = $3
                 AND EXISTS (SELECT FROM drafts WHERE map_uid = $1 AND holder = $5)
             ON CONFLICT DO NOTHING"
        );
        let query = sqlx::query(AssertSqlSafe(sql))
            .bind(self.next.uid)
            .bind(image.id.as_str())
            .bind(image.digest.as_bytes().as_slice())
            .bind(descriptor.as_slice())
            .bind(inner.process);
        inner.run(query).await.map(drop)
    }

    async fn replace(&mut self) -> Result<bool, StoreError> {
        let inner = self.store.inner.clone();
        inner
            .call(async {
                inner.check_revision(&self.old).await?;
                self.check_held(&inner.pool).await
            })
            .await?;
        if !self.indexed {
            // Before it serves: a large map should not be searched exactly until its index is there.
            self.indexed = self.build(&inner).await?;
        }
        let replaced = inner.call(self.put_in_place(&inner)).await?;
        if replaced {
            if self.indexed {
                inner.graphs.add(&self.next);
            }
            inner.drop_left(self.next.uid).await;
        }
        Ok(replaced)
    }

    async fn discard(self: Box<Self>) {
        let inner = &self.store.inner;
        let uid = self.next.uid;
        let own = sqlx::query("DELETE FROM drafts WHERE map_uid = $1 AND holder = $2")
            .bind(uid)
            .bind(inner.process);
        if let Err(error) = inner.run(own).await {
            tracing::warn!(%error, "a draft is left to the next one of the map");
        }
        inner.drop_left(uid).await;
    }
}

impl PostgresDraft {
    async fn missing_after(
        &self,
        inner: &Inner,
        after: i64,
        limit: usize,
    ) -> Result<Vec<(i64, Json<Image>)>, StoreError> {
        let table = table(self.next.uid, self.next.revision);
        let sql = format!(
            "SELECT i.slot, i.record FROM images i
             WHERE i.map_uid = $1 AND i.slot > $2
                 AND NOT EXISTS (SELECT FROM {table} d WHERE d.slot = i.slot)
             ORDER BY i.slot LIMIT $3"
        );
        let query = sqlx::query_as(AssertSqlSafe(sql)).bind(self.next.uid).bind(after);
        Ok(query.bind(count(limit)).fetch_all(&inner.pool).await?)
    }

    /// Builds the index, if the map is large enough for one.
    async fn build(&self, inner: &Inner) -> Result<bool, StoreError> {
        let table = table(self.next.uid, self.next.revision);
        let large = format!("SELECT count(*) FROM (SELECT FROM {table} LIMIT $1) counted");
        let exact = inner.settings.index.exact_up_to;
        let images: i64 = inner
            .call(async {
                let counting = sqlx::query_scalar(AssertSqlSafe(large)).bind(count(exact) + 1);
                Ok(counting.fetch_one(&inner.pool).await?)
            })
            .await?;
        if images <= count(exact) || self.next.dim > MOST_INDEXED {
            return Ok(false);
        }
        let mut connection = inner.pool.acquire().await?.detach();
        inner.index(&mut connection, &self.next).await?;
        Ok(true)
    }

    async fn put_in_place(&self, inner: &Inner) -> Result<bool, StoreError> {
        let (uid, table) = (self.next.uid, table(self.next.uid, self.next.revision));
        let mut tx = inner.begin().await?;
        // Whoever adds or removes an image waits from here on.
        let stored = sqlx::query_scalar("SELECT record FROM maps WHERE uid = $1 FOR UPDATE");
        let stored: Option<Json<Map>> = stored.bind(uid).fetch_optional(&mut *tx).await?;
        let Json(stored) = stored.ok_or_else(|| removed(&self.old))?;
        if stored.revision != self.old.revision {
            return Err(StoreError::Superseded(stored.name));
        }
        self.check_held(&mut *tx).await?;
        if self.lacks_some(&mut tx).await? {
            return Ok(false);
        }
        let removed = format!(
            "DELETE FROM {table} d WHERE NOT EXISTS (
                 SELECT FROM images WHERE map_uid = $1 AND slot = d.slot)"
        );
        sqlx::query(AssertSqlSafe(removed)).bind(uid).execute(&mut *tx).await?;
        // Scene and description may have changed.
        let map = Map { scene: stored.scene, description: stored.description, ..self.next.clone() };
        sqlx::query(
            "UPDATE maps SET revision = $2, record = $3::json, graph = $4, calibration = NULL,
                 measured_by = NULL WHERE uid = $1",
        )
        .bind(uid)
        .bind(i64::from(map.revision))
        .bind(record(&map)?)
        .bind(self.indexed)
        .execute(&mut *tx)
        .await?;
        // Their descriptors are not like those that come now.
        for gone in
            ["DELETE FROM frames WHERE map_uid = $1", "DELETE FROM drafts WHERE map_uid = $1"]
        {
            sqlx::query(gone).bind(uid).execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    /// Refuses a draft that was taken from this process, because it had not been heard of.
    async fn check_held(&self, executor: impl sqlx::PgExecutor<'_>) -> Result<(), StoreError> {
        let held = sqlx::query("SELECT FROM drafts WHERE map_uid = $1 AND holder = $2 FOR SHARE")
            .bind(self.next.uid)
            .bind(self.store.inner.process);
        match held.fetch_optional(executor).await? {
            Some(_) => Ok(()),
            None => Err(StoreError::Conflict(format!(
                "the reindexing of the map {} was given up, because this process had not been heard of \
                 for too long; begin it again",
                self.next.name
            ))),
        }
    }

    async fn lacks_some(&self, connection: &mut PgConnection) -> Result<bool, StoreError> {
        let table = table(self.next.uid, self.next.revision);
        let sql = format!(
            "SELECT EXISTS (SELECT FROM images i WHERE i.map_uid = $1
                 AND NOT EXISTS (SELECT FROM {table} d WHERE d.slot = i.slot))"
        );
        let lacking = sqlx::query_scalar(AssertSqlSafe(sql)).bind(self.next.uid);
        Ok(lacking.fetch_one(connection).await?)
    }
}
