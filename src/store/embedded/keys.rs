//! API keys, one record each. A revoked key is kept, so that the audit log can still be resolved.

use std::sync::Arc;

use async_trait::async_trait;

use super::super::{KeyStore, StoreError};
use super::trees::{decode, failed, put};
use super::{EmbeddedStore, blocking};
use whereabouts_core::StoredKey;

#[async_trait]
impl KeyStore for EmbeddedStore {
    async fn put_key(&self, key: StoredKey) -> Result<(), StoreError> {
        let keep = move |trees: &super::trees::Trees, _: &mut _| {
            put(&trees.keys, key.key.id.as_bytes(), &key)
        };
        self.inner.writer.commit(keep, |()| {}).await
    }

    async fn keys(&self) -> Result<Vec<StoredKey>, StoreError> {
        let inner = Arc::clone(&self.inner);
        blocking(move || {
            let values = inner.trees.keys.iter().values();
            values.map(|value| decode(&value.map_err(failed)?)).collect()
        })
        .await
    }
}
