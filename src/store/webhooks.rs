//! What a store promises of webhooks.

use async_trait::async_trait;
use jiff::Timestamp;
use tokio::sync::watch;
use uuid::Uuid;

use super::StoreError;
use whereabouts_core::{Attempt, Delivery, DeliveryState, StoredWebhook};

/// A delivery with what is posted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredDelivery {
    /// What callers see.
    pub delivery: Delivery,
    /// The body of the message, the same in every attempt.
    pub body: Vec<u8>,
}

/// Which deliveries are kept.
#[derive(Debug, Clone, Copy)]
pub struct DeliveryRetention {
    /// Of those that have ended, only those that ended since then, if it is given.
    pub since: Option<Timestamp>,
    /// Only so many: the first to end go first, and if that is not enough, the oldest of those that wait.
    pub most: usize,
}

/// How many deliveries were removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RemovedDeliveries {
    /// That had ended.
    pub ended: usize,
    /// That were still waiting.
    pub waiting: usize,
}

/// Webhooks and their deliveries.
///
/// The store queues the deliveries of a job's end itself, in the change that ends the job: neither is
/// there without the other.
#[async_trait]
pub trait WebhookStore: Send + Sync {
    /// Adds a webhook unless there are `most` ([`StoreError::Conflict`]).
    async fn add_webhook(&self, webhook: StoredWebhook, most: usize) -> Result<(), StoreError>;
    /// All webhooks, oldest first.
    async fn webhooks(&self) -> Result<Vec<StoredWebhook>, StoreError>;
    /// One webhook.
    async fn webhook(&self, id: Uuid) -> Result<Option<StoredWebhook>, StoreError>;
    /// From now on a webhook is told nothing; what waits for it is left as it is.
    async fn disable_webhook(&self, id: Uuid, at: Timestamp, why: &str) -> Result<(), StoreError>;
    /// Removes a webhook with all its deliveries; `false` if there was none.
    async fn delete_webhook(&self, id: Uuid) -> Result<bool, StoreError>;

    /// Queues a delivery; [`StoreError::Conflict`] if its webhook is disabled.
    async fn queue_delivery(&self, delivery: StoredDelivery) -> Result<(), StoreError>;
    /// Queues a delivery anew that does not wait; [`StoreError::Conflict`] if it does, or its webhook is
    /// disabled.
    async fn queue_again(
        &self,
        webhook: Uuid,
        id: Uuid,
        now: Timestamp,
    ) -> Result<Delivery, StoreError>;
    /// Deliveries of a webhook, newest first, those older than `before`, at most `limit`.
    async fn deliveries(
        &self,
        webhook: Uuid,
        state: Option<DeliveryState>,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<Vec<Delivery>, StoreError>;
    /// Deliveries of a webhook that wait and are due, those that are due for longest first, at most `limit`.
    async fn due_deliveries(
        &self,
        webhook: Uuid,
        now: Timestamp,
        limit: usize,
    ) -> Result<Vec<StoredDelivery>, StoreError>;
    /// Notes an attempt; the delivery as it then is, or `None` if it waits no more.
    async fn note_attempt(
        &self,
        webhook: Uuid,
        id: Uuid,
        attempt: Attempt,
    ) -> Result<Option<Delivery>, StoreError>;
    /// Gives up deliveries of a webhook that wait, at most `limit`. Returns how many.
    async fn give_up_deliveries(
        &self,
        webhook: Uuid,
        at: Timestamp,
        why: &str,
        limit: usize,
    ) -> Result<usize, StoreError>;
    /// Removes deliveries that are not to be kept, at most `batch` of them, so that no change waits long.
    async fn forget_deliveries(
        &self,
        keep: DeliveryRetention,
        batch: usize,
    ) -> Result<RemovedDeliveries, StoreError>;
    /// Deliveries that wait.
    async fn waiting_deliveries(&self) -> Result<usize, StoreError>;
    /// Told when deliveries were queued.
    fn queued_deliveries(&self) -> watch::Receiver<()>;
}
