//! Webhooks and the outbox of their deliveries.

use async_trait::async_trait;
use jiff::Timestamp;
use tokio::sync::watch;
use uuid::Uuid;

use super::StoreError;
use whereabouts_core::{Attempt, Delivery, DeliveryState, StoredWebhook};

/// A delivery with the message to post.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredDelivery {
    /// The delivery as the API returns it.
    pub delivery: Delivery,
    /// The body of the message, identical in every attempt.
    pub body: Vec<u8>,
}

/// Which deliveries to keep.
#[derive(Debug, Clone, Copy)]
pub struct DeliveryRetention {
    /// Removes deliveries that ended before this moment.
    pub since: Option<Timestamp>,
    /// Keeps at most this many deliveries: those that ended first are removed first, then the oldest
    /// waiting ones.
    pub most: usize,
}

/// How many deliveries were removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RemovedDeliveries {
    /// Deliveries that had ended.
    pub ended: usize,
    /// Deliveries that were still waiting.
    pub waiting: usize,
}

/// Webhooks and their deliveries.
///
/// The store is a transactional outbox: it queues the deliveries about a job's end in the transaction
/// that ends the job.
#[async_trait]
pub trait WebhookStore: Send + Sync {
    /// Adds a webhook unless there are already `max` ([`StoreError::Conflict`]).
    async fn add_webhook(&self, webhook: StoredWebhook, max: usize) -> Result<(), StoreError>;
    /// Returns all webhooks, oldest first.
    async fn webhooks(&self) -> Result<Vec<StoredWebhook>, StoreError>;
    /// Returns one webhook.
    async fn webhook(&self, id: Uuid) -> Result<Option<StoredWebhook>, StoreError>;
    /// Disables a webhook: nothing more is queued for it. Its waiting deliveries are not changed.
    async fn disable_webhook(&self, id: Uuid, at: Timestamp, why: &str) -> Result<(), StoreError>;
    /// Deletes a webhook with all its deliveries. Returns `false` if there was no such webhook.
    async fn delete_webhook(&self, id: Uuid) -> Result<bool, StoreError>;

    /// Queues a delivery; [`StoreError::Conflict`] if its webhook is disabled.
    async fn queue_delivery(&self, delivery: StoredDelivery) -> Result<(), StoreError>;
    /// Queues an ended delivery again; [`StoreError::Conflict`] if it is still waiting or its webhook is
    /// disabled.
    async fn queue_again(
        &self,
        webhook: Uuid,
        id: Uuid,
        now: Timestamp,
    ) -> Result<Delivery, StoreError>;
    /// Returns up to `limit` deliveries of a webhook older than `before`, newest first.
    async fn deliveries(
        &self,
        webhook: Uuid,
        state: Option<DeliveryState>,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<Vec<Delivery>, StoreError>;
    /// Returns up to `limit` waiting deliveries of a webhook that are due, the longest overdue first.
    async fn due_deliveries(
        &self,
        webhook: Uuid,
        now: Timestamp,
        limit: usize,
    ) -> Result<Vec<StoredDelivery>, StoreError>;
    /// Records an attempt. Returns the delivery in its new state, or `None` if it was no longer waiting. May be
    /// repeated: an attempt that ended at the same time as the last one is that one.
    async fn note_attempt(
        &self,
        webhook: Uuid,
        id: Uuid,
        attempt: Attempt,
    ) -> Result<Option<Delivery>, StoreError>;
    /// Gives up at most `limit` waiting deliveries of a webhook. Returns the number given up.
    async fn give_up_deliveries(
        &self,
        webhook: Uuid,
        at: Timestamp,
        why: &str,
        limit: usize,
    ) -> Result<usize, StoreError>;
    /// Removes up to `batch` deliveries that need not be kept. Small batches keep other writes from
    /// waiting long.
    async fn forget_deliveries(
        &self,
        keep: DeliveryRetention,
        batch: usize,
    ) -> Result<RemovedDeliveries, StoreError>;
    /// Returns the number of waiting deliveries.
    async fn waiting_deliveries(&self) -> Result<usize, StoreError>;
    /// Returns a receiver that is notified when deliveries were queued.
    fn queued_deliveries(&self) -> watch::Receiver<()>;
}
