//! API keys.

use async_trait::async_trait;
use tokio::sync::watch;

use super::StoreError;
use whereabouts_core::StoredKey;

/// API keys.
#[async_trait]
pub trait KeyStore: Send + Sync {
    /// Stores a key, replacing the key with the same id.
    async fn put_key(&self, key: StoredKey) -> Result<(), StoreError>;
    /// Returns all keys, in no particular order.
    async fn keys(&self) -> Result<Vec<StoredKey>, StoreError>;
    /// Returns a receiver that is notified when any process creates or revokes a key; `None` if the
    /// store has a single process.
    fn changed_keys(&self) -> Option<watch::Receiver<()>> {
        None
    }
}
