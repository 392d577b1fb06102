//! Image bytes: in the object store, with a row each that counts who needs them.
//!
//! Bytes are put like this: the row first, pinned for a while; then the object, if it is not there. They are
//! removed like this: the row is locked and the object removed while it is, so that whoever puts the same
//! bytes at that moment waits, and then finds them gone.

use async_trait::async_trait;
use bytes::Bytes;

use super::super::{BlobPin, BlobStore, StoreError};
use super::{Inner, PostgresStore, count};
use whereabouts_core::Digest;

/// Bytes of so many pictures are removed in one transaction.
const REMOVED_AT_ONCE: i64 = 64;

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
        // The row says how long they are kept: longer than anybody takes to refer to them.
        Ok(Box::new(()))
    }

    async fn blob(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        self.inner.objects.get(digest).await
    }
}

impl Inner {
    /// Removes bytes that nobody needs; returns how many.
    pub(super) async fn remove_unneeded(&self) -> Result<u64, StoreError> {
        let mut removed = 0;
        loop {
            let some = self.call(self.remove_some()).await?;
            removed += some.iter().sum::<u64>();
            if some.len() < REMOVED_AT_ONCE as usize {
                return Ok(removed);
            }
        }
    }

    async fn remove_some(&self) -> Result<Vec<u64>, StoreError> {
        let mut tx = self.begin().await?;
        let unneeded: Vec<(Vec<u8>, i64)> = sqlx::query_as(
            "DELETE FROM blobs WHERE digest IN (
                 SELECT digest FROM blobs WHERE needed <= 0 AND pinned_until <= now()
                 ORDER BY pinned_until LIMIT $1 FOR UPDATE SKIP LOCKED)
             RETURNING digest, size",
        )
        .bind(REMOVED_AT_ONCE)
        .fetch_all(&mut *tx)
        .await?;
        let mut sizes = Vec::new();
        for (digest, size) in unneeded {
            self.objects.remove(&digest_of(&digest)?).await?;
            sizes.push(size.unsigned_abs());
        }
        tx.commit().await?;
        Ok(sizes)
    }
}

/// A digest as it is stored.
pub(super) fn digest_of(bytes: &[u8]) -> Result<Digest, StoreError> {
    let bytes: Result<[u8; 32], _> = bytes.try_into();
    bytes.map(Digest::from).map_err(|_| {
        StoreError::Damaged("a digest of the database is not of 32 bytes; restore a backup".into())
    })
}

/// Bytes that a record refers to were not put, or too long ago.
pub(super) fn not_stored(digest: &Digest) -> StoreError {
    StoreError::Failed(format!("the bytes of {digest} are not stored; send them again"))
}
