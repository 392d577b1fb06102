//! Image bytes: an object in the object store, and a row that counts the references to it.
//!
//! Storing writes the row first, pinned for a while, and then the object if it is missing. Removal locks
//! the row and deletes the object before it commits, so that a concurrent upload of the same bytes waits
//! and then finds the object missing.

use async_trait::async_trait;
use bytes::Bytes;

use super::super::{BlobPin, BlobStore, StoreError};
use super::{Inner, PostgresStore, count};
use whereabouts_core::Digest;

/// Objects removed in one transaction.
const REMOVAL_BATCH: i64 = 64;

#[async_trait]
impl BlobStore for PostgresStore {
    async fn put_blob(&self, digest: Digest, bytes: Bytes) -> Result<BlobPin, StoreError> {
        let inner = &self.inner;
        let pinned = sqlx::query(
            "INSERT INTO blobs (digest, size, pinned_until)
             VALUES ($1, $2, now() + make_interval(secs => $3))
             ON CONFLICT (digest) DO UPDATE
             SET pinned_until = greatest(blobs.pinned_until, EXCLUDED.pinned_until)",
        )
        .bind(digest.as_bytes().as_slice())
        .bind(count(bytes.len()))
        .bind(inner.settings.pin.as_secs_f64());
        inner.run(pinned).await?;
        inner.objects.put(&digest, bytes).await?;
        // The row holds the pin: `pinned_until` leaves enough time to refer to the bytes.
        Ok(Box::new(()))
    }

    async fn blob(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        self.inner.objects.get(digest).await
    }
}

impl Inner {
    /// Removes bytes without a reference or a pin; returns their size.
    pub(super) async fn remove_unreferenced(&self) -> Result<u64, StoreError> {
        let mut removed = 0;
        loop {
            let sizes = self.call(self.remove_batch()).await?;
            removed += sizes.iter().sum::<u64>();
            if sizes.len() < REMOVAL_BATCH as usize {
                return Ok(removed);
            }
        }
    }

    async fn remove_batch(&self) -> Result<Vec<u64>, StoreError> {
        let mut tx = self.begin().await?;
        let unreferenced: Vec<(Vec<u8>, i64)> = sqlx::query_as(
            "DELETE FROM blobs WHERE digest IN (
                 SELECT digest FROM blobs WHERE needed <= 0 AND pinned_until <= now()
                 ORDER BY pinned_until LIMIT $1 FOR UPDATE SKIP LOCKED)
             RETURNING digest, size",
        )
        .bind(REMOVAL_BATCH)
        .fetch_all(&mut *tx)
        .await?;
        let mut sizes = Vec::new();
        for (digest, size) in unreferenced {
            self.objects.remove(&digest_of(&digest)?).await?;
            sizes.push(size.unsigned_abs());
        }
        tx.commit().await?;
        Ok(sizes)
    }
}

/// Decodes a stored digest.
pub(super) fn digest_of(bytes: &[u8]) -> Result<Digest, StoreError> {
    let bytes: Result<[u8; 32], _> = bytes.try_into();
    bytes.map(Digest::from).map_err(|_| {
        StoreError::Damaged("a stored digest does not have 32 bytes; restore a backup".into())
    })
}

/// The error of a record whose bytes were never stored, or whose pin has expired.
pub(super) fn not_stored(digest: &Digest) -> StoreError {
    StoreError::Failed(format!("the bytes of {digest} are not stored; send them again"))
}
