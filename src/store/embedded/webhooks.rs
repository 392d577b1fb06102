//! Webhooks and their deliveries.
//!
//! A waiting delivery has a key in `due`, any other one in `ended`; both change together with the
//! delivery in one transaction. The body of the message is a separate record, so that attempts do not
//! rewrite it.

pub(super) mod trees;

use std::sync::Arc;

use async_trait::async_trait;
use jiff::Timestamp;
use tokio::sync::watch;
use uuid::Uuid;

use super::super::changes::{
    attempted, check_ended, disable, no_delivery, no_webhook, too_many_webhooks,
};
use super::super::{
    DeliveryRetention, RemovedDeliveries, StoreError, StoredDelivery, WebhookStore,
};
use super::records::{decode, failed, put};
use super::trees::Trees;
use super::{EmbeddedStore, blocking};
use whereabouts_core::{Attempt, Delivery, DeliveryState, StoredWebhook};

use self::trees::{DeliveryRecord, WebhookTrees, key};

/// Deliveries removed in one change when their webhook is deleted.
const REMOVAL_BATCH: usize = 256;

impl EmbeddedStore {
    /// Applies a change to webhooks.
    async fn change_webhooks<T, F>(&self, change: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&WebhookTrees) -> Result<T, StoreError> + Send + 'static,
    {
        let change = move |trees: &Trees, _: &mut _| change(&trees.webhooks);
        self.inner.writer.commit(change, |_| {}).await
    }

    /// Reads webhooks.
    async fn read_webhooks<T, F>(&self, read: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&WebhookTrees) -> Result<T, StoreError> + Send + 'static,
    {
        let inner = Arc::clone(&self.inner);
        blocking(move || read(&inner.trees.webhooks)).await
    }
}

#[async_trait]
impl WebhookStore for EmbeddedStore {
    async fn add_webhook(&self, webhook: StoredWebhook, max: usize) -> Result<(), StoreError> {
        self.change_webhooks(move |trees| {
            if trees.webhooks.len() >= max {
                return Err(too_many_webhooks(max));
            }
            put(&trees.webhooks, webhook.webhook.id.as_bytes(), &webhook)
        })
        .await
    }

    async fn webhooks(&self) -> Result<Vec<StoredWebhook>, StoreError> {
        self.read_webhooks(|trees| {
            let values = trees.webhooks.iter().values();
            values.map(|value| decode(&value.map_err(failed)?)).collect()
        })
        .await
    }

    async fn webhook(&self, id: Uuid) -> Result<Option<StoredWebhook>, StoreError> {
        self.read_webhooks(move |trees| trees.webhook(id)).await
    }

    async fn disable_webhook(&self, id: Uuid, at: Timestamp, why: &str) -> Result<(), StoreError> {
        let why = why.to_owned();
        self.change_webhooks(move |trees| {
            let Some(mut stored) = trees.webhook(id)? else { return Ok(()) };
            if disable(&mut stored, at, &why) {
                put(&trees.webhooks, id.as_bytes(), &stored)?;
            }
            Ok(())
        })
        .await
    }

    async fn delete_webhook(&self, id: Uuid) -> Result<bool, StoreError> {
        loop {
            // The webhook is deleted last, so that an interruption leaves no orphaned deliveries.
            let remove_batch = move |trees: &WebhookTrees| {
                let batch = trees.some_of(id, REMOVAL_BATCH)?;
                batch.iter().try_for_each(|delivery| trees.remove(delivery))?;
                if batch.len() == REMOVAL_BATCH {
                    return Ok(None);
                }
                let removed = trees.webhooks.remove(id.as_bytes()).map_err(failed)?;
                Ok(Some(removed.is_some()))
            };
            if let Some(existed) = self.change_webhooks(remove_batch).await? {
                return Ok(existed);
            }
        }
    }

    async fn queue_delivery(&self, new: StoredDelivery) -> Result<(), StoreError> {
        self.change_webhooks(move |trees| {
            trees.enabled(new.delivery.webhook)?;
            trees.queue(&DeliveryRecord::new(&new.delivery, new.body)?)
        })
        .await?;
        self.inner.deliveries.send_replace(());
        Ok(())
    }

    async fn queue_again(
        &self,
        webhook: Uuid,
        id: Uuid,
        now: Timestamp,
    ) -> Result<Delivery, StoreError> {
        let queued = self.change_webhooks(move |trees| {
            let Some(ended) = trees.delivery(&key(webhook, id))? else {
                trees.webhook(webhook)?.ok_or_else(|| no_webhook(webhook))?;
                return Err(no_delivery(id));
            };
            trees.enabled(webhook)?;
            check_ended(&ended)?;
            let again = ended.clone().requeued(now);
            trees.replace(&ended, &again)?;
            Ok(again)
        });
        let queued = queued.await?;
        self.inner.deliveries.send_replace(());
        Ok(queued)
    }

    async fn deliveries(
        &self,
        webhook: Uuid,
        state: Option<DeliveryState>,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<Vec<Delivery>, StoreError> {
        self.read_webhooks(move |trees| {
            let end = key(webhook, before.unwrap_or(Uuid::max()));
            let older = trees.deliveries.range(webhook.as_bytes().to_vec()..end.to_vec()).rev();
            older
                .map(|entry| decode(&entry.map_err(failed)?.1))
                .filter(|delivery: &Result<Delivery, StoreError>| {
                    let state_is = |delivery: &Delivery| state.is_none_or(|s| s == delivery.state);
                    delivery.as_ref().map_or(true, state_is)
                })
                .take(limit)
                .collect()
        })
        .await
    }

    async fn due_deliveries(
        &self,
        webhook: Uuid,
        now: Timestamp,
        limit: usize,
    ) -> Result<Vec<StoredDelivery>, StoreError> {
        self.read_webhooks(move |trees| {
            let mut due = Vec::new();
            for key in trees.due_until(webhook, now, limit)? {
                let body = trees.bodies.get(key).map_err(failed)?;
                // If one of them is missing, the delivery was removed between the reads.
                if let (Some(delivery), Some(body)) = (trees.delivery(&key)?, body) {
                    due.push(StoredDelivery { delivery, body: body.to_vec() });
                }
            }
            Ok(due)
        })
        .await
    }

    async fn note_attempt(
        &self,
        webhook: Uuid,
        id: Uuid,
        attempt: Attempt,
    ) -> Result<Option<Delivery>, StoreError> {
        self.change_webhooks(move |trees| {
            let Some(before) = trees.delivery(&key(webhook, id))? else { return Ok(None) };
            let Some(after) = attempted(before.clone(), attempt) else { return Ok(None) };
            trees.replace(&before, &after)?;
            Ok(Some(after))
        })
        .await
    }

    async fn give_up_deliveries(
        &self,
        webhook: Uuid,
        at: Timestamp,
        why: &str,
        limit: usize,
    ) -> Result<usize, StoreError> {
        // A read costs no commit.
        let first = move |trees: &WebhookTrees| trees.due_until(webhook, Timestamp::MAX, 1);
        if self.read_webhooks(first).await?.is_empty() {
            return Ok(0);
        }
        let why = why.to_owned();
        self.change_webhooks(move |trees| {
            let keys = trees.due_until(webhook, Timestamp::MAX, limit)?;
            for key in &keys {
                if let Some(waiting) = trees.delivery(key)? {
                    trees.replace(&waiting, &waiting.clone().dead_lettered(at, &why))?;
                }
            }
            Ok(keys.len())
        })
        .await
    }

    async fn forget_deliveries(
        &self,
        keep: DeliveryRetention,
        batch: usize,
    ) -> Result<RemovedDeliveries, StoreError> {
        // A read costs no commit.
        if self.read_webhooks(move |trees| trees.surplus(keep, 1)).await?.is_empty() {
            return Ok(RemovedDeliveries::default());
        }
        self.change_webhooks(move |trees| {
            let mut removed = RemovedDeliveries::default();
            for key in trees.surplus(keep, batch)? {
                let Some(delivery) = trees.delivery(&key)? else { continue };
                match delivery.state {
                    DeliveryState::Waiting => removed.waiting += 1,
                    _ => removed.ended += 1,
                }
                trees.remove(&delivery)?;
            }
            Ok(removed)
        })
        .await
    }

    async fn waiting_deliveries(&self) -> Result<usize, StoreError> {
        self.read_webhooks(|trees| Ok(trees.due.len())).await
    }

    fn queued_deliveries(&self) -> watch::Receiver<()> {
        self.inner.deliveries.subscribe()
    }
}

#[cfg(test)]
mod tests;
