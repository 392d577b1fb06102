//! Drafts: new descriptors in a separate table, and their atomic replacement of the current one.

use async_trait::async_trait;
use sqlx::types::Json;
use sqlx::{AssertSqlSafe, PgConnection};

use super::super::changes::{being_reindexed, removed};
use super::super::{Draft, DraftStore, StoreError};
use super::descriptors::{MAX_INDEXED_DIM, create_table, drop_table, table};
use super::maps::vocabulary;
use super::{Inner, PostgresStore, count, record};
use whereabouts_core::{Descriptor, Image, Map};

struct PostgresDraft {
    store: PostgresStore,
    /// The map as it is.
    old: Map,
    /// The map as it will be.
    next: Map,
    /// The last slot examined by the current pass over the images.
    seen: i64,
    /// Whether the draft's index was built.
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
                let acquired = sqlx::query(
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
                if acquired.rows_affected() == 0 {
                    return Err(being_reindexed(&next));
                }
                // A dead process may have left its table.
                drop_table(&mut tx, next.uid, next.revision).await?;
                create_table(&mut tx, &next).await?;
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
                    let page = self.missing_after(&inner, from, limit).await?;
                    if let Some((last, _)) = page.last() {
                        self.seen = *last;
                        return Ok(page.into_iter().map(|(_, Json(image))| image).collect());
                    }
                    if from == 0 {
                        return Ok(Vec::new());
                    }
                    // Start another pass, because slots are assigned before images become visible.
                    self.seen = 0;
                }
            })
            .await
    }

    async fn write(&mut self, image: &Image, descriptor: Descriptor) -> Result<(), StoreError> {
        let inner = &self.store.inner;
        let table = table(self.next.uid, self.next.revision);
        // If the id now belongs to another image, a later pass finds that one.
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
            // Build the index first, so that a large map is never searched exactly.
            self.indexed = self.build_index(&inner).await?;
        }
        let replaced = inner.call(self.swap(&inner)).await?;
        if replaced {
            if self.indexed {
                inner.graphs.add(&self.next);
            }
            inner.drop_unused_tables_of(self.next.uid).await;
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
            tracing::warn!(%error, "cannot delete a draft; the next draft of the map replaces it");
        }
        inner.drop_unused_tables_of(uid).await;
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

    /// Builds the index if the map is large enough. Returns whether there is one.
    async fn build_index(&self, inner: &Inner) -> Result<bool, StoreError> {
        let table = table(self.next.uid, self.next.revision);
        let large = format!("SELECT count(*) FROM (SELECT FROM {table} LIMIT $1) counted");
        let exact = inner.settings.index.exact_up_to;
        let images: i64 = inner
            .call(async {
                let counting = sqlx::query_scalar(AssertSqlSafe(large)).bind(count(exact) + 1);
                Ok(counting.fetch_one(&inner.pool).await?)
            })
            .await?;
        if images <= count(exact) || self.next.dim > MAX_INDEXED_DIM {
            return Ok(false);
        }
        let mut connection = inner.pool.acquire().await?.detach();
        inner.create_index(&mut connection, &self.next).await?;
        Ok(true)
    }

    /// Replaces the current descriptors. Returns `false` if the draft is incomplete.
    async fn swap(&self, inner: &Inner) -> Result<bool, StoreError> {
        let (uid, table) = (self.next.uid, table(self.next.uid, self.next.revision));
        let mut tx = inner.begin().await?;
        // From here on, additions and removals of images wait.
        let stored = sqlx::query_scalar("SELECT record FROM maps WHERE uid = $1 FOR UPDATE");
        let stored: Option<Json<Map>> = stored.bind(uid).fetch_optional(&mut *tx).await?;
        let Json(stored) = stored.ok_or_else(|| removed(&self.old))?;
        if stored.revision != self.old.revision {
            return Err(StoreError::Superseded(stored.name));
        }
        self.check_held(&mut *tx).await?;
        if self.is_incomplete(&mut tx).await? {
            return Ok(false);
        }
        let removed = format!(
            "DELETE FROM {table} d WHERE NOT EXISTS (
                 SELECT FROM images WHERE map_uid = $1 AND slot = d.slot)"
        );
        sqlx::query(AssertSqlSafe(removed)).bind(uid).execute(&mut *tx).await?;
        // Scene, coordinate frame and description may have changed meanwhile.
        let Map { scene, frame, refiner, description, .. } = stored;
        let map = Map { scene, frame, refiner, description, ..self.next.clone() };
        sqlx::query(
            "UPDATE maps SET revision = $2, record = $3::json, graph = $4, vocabulary = $5,
                 indexed_revision = CASE WHEN $4 THEN $2 END, calibration = NULL, measured_by = NULL
             WHERE uid = $1",
        )
        .bind(uid)
        .bind(i64::from(map.revision))
        .bind(record(&map)?)
        .bind(self.indexed)
        .bind(vocabulary(&map))
        .execute(&mut *tx)
        .await?;
        // The descriptors of described frames belong to the old revision.
        for obsolete in
            ["DELETE FROM frames WHERE map_uid = $1", "DELETE FROM drafts WHERE map_uid = $1"]
        {
            sqlx::query(obsolete).bind(uid).execute(&mut *tx).await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    /// Refuses a draft that another process took over because the heartbeats of this one had stopped.
    async fn check_held(&self, executor: impl sqlx::PgExecutor<'_>) -> Result<(), StoreError> {
        let held = sqlx::query("SELECT FROM drafts WHERE map_uid = $1 AND holder = $2 FOR SHARE")
            .bind(self.next.uid)
            .bind(self.store.inner.process);
        match held.fetch_optional(executor).await? {
            Some(_) => Ok(()),
            None => Err(StoreError::Conflict(format!(
                "the reindexing of the map {} was abandoned, because the heartbeats of this process had \
                 stopped; start it again",
                self.next.name
            ))),
        }
    }

    /// Whether some image has no descriptor in the draft.
    async fn is_incomplete(&self, connection: &mut PgConnection) -> Result<bool, StoreError> {
        let table = table(self.next.uid, self.next.revision);
        let sql = format!(
            "SELECT EXISTS (SELECT FROM images i WHERE i.map_uid = $1
                 AND NOT EXISTS (SELECT FROM {table} d WHERE d.slot = i.slot))"
        );
        let incomplete = sqlx::query_scalar(AssertSqlSafe(sql)).bind(self.next.uid);
        Ok(incomplete.fetch_one(connection).await?)
    }
}
