//! Webhooks and their deliveries.
//!
//! A delivery that waits has a place in `due`, one that does not in `ended`; both change with it in one
//! transaction. The body of its message is a record of its own, which no attempt writes again.

mod trees;

use std::sync::Arc;

use async_trait::async_trait;
use jiff::Timestamp;
use tokio::sync::watch;
use uuid::Uuid;

use super::super::changes::{
    attempted, check_ended, disable, no_delivery, no_webhook, too_many_webhooks,
};
use super::super::{ForgottenDeliveries, KeepDeliveries, StoreError, StoredDelivery, WebhookStore};
use super::trees::{Trees, decode, failed, put};
use super::{EmbeddedStore, blocking};
use whereabouts_core::{Attempt, Delivery, DeliveryState, StoredWebhook};

pub(super) use self::trees::WebhookTrees;
use self::trees::{News, key};

/// Deliveries removed in one change when their webhook is.
const REMOVED_AT_ONCE: usize = 256;

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

    /// Looks at webhooks.
    async fn look_at_webhooks<T, F>(&self, look: F) -> Result<T, StoreError>
    where
        T: Send + 'static,
        F: FnOnce(&WebhookTrees) -> Result<T, StoreError> + Send + 'static,
    {
        let inner = Arc::clone(&self.inner);
        blocking(move || look(&inner.trees.webhooks)).await
    }
}

#[async_trait]
impl WebhookStore for EmbeddedStore {
    async fn add_webhook(&self, webhook: StoredWebhook, most: usize) -> Result<(), StoreError> {
        self.change_webhooks(move |trees| {
            if trees.webhooks.len() >= most {
                return Err(too_many_webhooks(most));
            }
            put(&trees.webhooks, webhook.webhook.id.as_bytes(), &webhook)
        })
        .await
    }

    async fn webhooks(&self) -> Result<Vec<StoredWebhook>, StoreError> {
        self.look_at_webhooks(|trees| {
            let values = trees.webhooks.iter().values();
            values.map(|value| decode(&value.map_err(failed)?)).collect()
        })
        .await
    }

    async fn webhook(&self, id: Uuid) -> Result<Option<StoredWebhook>, StoreError> {
        self.look_at_webhooks(move |trees| trees.webhook(id)).await
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
            // The webhook goes last, so that a process that ends meanwhile leaves nothing that belongs to
            // none.
            let removing = move |trees: &WebhookTrees| {
                let some = trees.some_of(id, REMOVED_AT_ONCE)?;
                some.iter().try_for_each(|delivery| trees.remove(delivery))?;
                if some.len() == REMOVED_AT_ONCE {
                    return Ok(None);
                }
                let removed = trees.webhooks.remove(id.as_bytes()).map_err(failed)?;
                Ok(Some(removed.is_some()))
            };
            if let Some(there) = self.change_webhooks(removing).await? {
                return Ok(there);
            }
        }
    }

    async fn queue_delivery(&self, new: StoredDelivery) -> Result<(), StoreError> {
        self.change_webhooks(move |trees| {
            trees.enabled(new.delivery.webhook)?;
            trees.queue(&News::of(&new.delivery, new.body)?)
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
            let Some(known) = trees.delivery(&key(webhook, id))? else {
                trees.webhook(webhook)?.ok_or_else(|| no_webhook(webhook))?;
                return Err(no_delivery(id));
            };
            trees.enabled(webhook)?;
            check_ended(&known)?;
            let again = known.clone().requeued(now);
            trees.replace(&known, &again)?;
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
        self.look_at_webhooks(move |trees| {
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
        self.look_at_webhooks(move |trees| {
            let mut due = Vec::new();
            for key in trees.due_until(webhook, now, limit)? {
                let body = trees.bodies.get(key).map_err(failed)?;
                // One without the other was removed between the two looks.
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
            let Some(known) = trees.delivery(&key(webhook, id))? else { return Ok(None) };
            let Some(after) = attempted(known.clone(), attempt) else { return Ok(None) };
            trees.replace(&known, &after)?;
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
        // Looking costs no commit.
        let some = move |trees: &WebhookTrees| trees.due_until(webhook, Timestamp::MAX, 1);
        if self.look_at_webhooks(some).await?.is_empty() {
            return Ok(0);
        }
        let why = why.to_owned();
        self.change_webhooks(move |trees| {
            let keys = trees.due_until(webhook, Timestamp::MAX, limit)?;
            for key in &keys {
                if let Some(known) = trees.delivery(key)? {
                    trees.replace(&known, &known.clone().dead_lettered(at, &why))?;
                }
            }
            Ok(keys.len())
        })
        .await
    }

    async fn forget_deliveries(
        &self,
        keep: KeepDeliveries,
        batch: usize,
    ) -> Result<ForgottenDeliveries, StoreError> {
        // Looking costs no commit.
        if self.look_at_webhooks(move |trees| trees.surplus(keep, 1)).await?.is_empty() {
            return Ok(ForgottenDeliveries::default());
        }
        self.change_webhooks(move |trees| {
            let mut forgotten = ForgottenDeliveries::default();
            for key in trees.surplus(keep, batch)? {
                let Some(delivery) = trees.delivery(&key)? else { continue };
                match delivery.state {
                    DeliveryState::Waiting => forgotten.waiting += 1,
                    _ => forgotten.ended += 1,
                }
                trees.remove(&delivery)?;
            }
            Ok(forgotten)
        })
        .await
    }

    async fn waiting_deliveries(&self) -> Result<usize, StoreError> {
        self.look_at_webhooks(|trees| Ok(trees.due.len())).await
    }

    fn queued_deliveries(&self) -> watch::Receiver<()> {
        self.inner.deliveries.subscribe()
    }
}

#[cfg(test)]
mod tests;
