//! API keys.

use async_trait::async_trait;
use tokio::sync::watch;

use super::super::{KeyStore, StoreError};
use super::listener::KEYS;
use super::{PostgresStore, record};
use whereabouts_core::StoredKey;

#[async_trait]
impl KeyStore for PostgresStore {
    async fn put_key(&self, key: StoredKey) -> Result<(), StoreError> {
        let inner = &self.inner;
        let query = sqlx::query(
            "WITH told AS (SELECT pg_notify($3, ''))
             INSERT INTO keys (id, record) SELECT $1, $2::json FROM told
             ON CONFLICT (id) DO UPDATE SET record = EXCLUDED.record",
        )
        .bind(key.key.id.clone())
        .bind(record(&key)?)
        .bind(KEYS);
        inner.run(query).await.map(drop)
    }

    async fn keys(&self) -> Result<Vec<StoredKey>, StoreError> {
        self.inner.all(sqlx::query_scalar("SELECT record FROM keys")).await
    }

    fn changed_keys(&self) -> Option<watch::Receiver<()>> {
        Some(self.inner.keys.subscribe())
    }
}
