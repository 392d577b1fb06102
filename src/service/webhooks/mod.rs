//! Webhooks: create, list, delete and test them, and list their deliveries.
//!
//! The store queues a delivery in the transaction that ends a job. The [`Dispatcher`] delivers it: `messenger` posts
//! it, `signature` signs it, and `address` keeps it out of private networks.

mod address;
mod dispatcher;
mod messenger;
mod settings;
mod signature;

use std::sync::Arc;

use jiff::Timestamp;
use uuid::Uuid;

pub use self::dispatcher::Dispatcher;
pub use self::settings::WebhookSettings;
#[cfg(test)]
pub(crate) use self::settings::tests::defaults;
use super::ServiceError;
use super::images::page_size;
use super::keys::random;
use whereabouts_api::{DeliveryPage, ErrorKind, MadeWebhook, NewWebhook};
use whereabouts_core::{
    Delivery, DeliveryState, Message, StoredWebhook, Webhook, WebhookEvent, WebhookSecret,
};
use whereabouts_store::{StoredDelivery, WebhookStore};

/// All webhooks.
pub struct Webhooks {
    /// Webhooks and their deliveries.
    pub store: Arc<dyn WebhookStore>,
    /// Bounds of webhooks.
    pub settings: WebhookSettings,
}

impl Webhooks {
    /// Creates a webhook. Its secret is in the returned value only and cannot be read again.
    pub async fn create(&self, new: NewWebhook) -> Result<MadeWebhook, ServiceError> {
        let NewWebhook { url, mut events, map } = new;
        let url = address::parse(&url, self.settings.allow_private)
            .map_err(ServiceError::unprocessable)?;
        events.sort();
        events.dedup();
        if events.is_empty() || events.contains(&WebhookEvent::Ping) {
            let detail = "events must name ends of jobs, such as \"job.succeeded\", or be left out for all \
                          of them; POST /webhooks/{id}/test sends a ping";
            return Err(ServiceError::unprocessable(detail));
        }
        let webhook = Webhook {
            id: Uuid::now_v7(),
            url: url.into(),
            events,
            map,
            created_at: Timestamp::now(),
            disabled_at: None,
            disabled_reason: None,
        };
        let stored = StoredWebhook { webhook, secret: WebhookSecret::new(&random("webhook")?) };
        self.store.add_webhook(stored.clone(), self.settings.max).await?;
        let StoredWebhook { webhook, secret } = stored;
        tracing::info!(target: "audit", made = %webhook.id, "a webhook was made");
        Ok(MadeWebhook { webhook, secret })
    }

    /// Returns all webhooks, newest first.
    pub async fn list(&self) -> Result<Vec<Webhook>, ServiceError> {
        let stored = self.store.webhooks().await?;
        Ok(stored.into_iter().rev().map(|stored| stored.webhook).collect())
    }

    /// Returns a webhook.
    pub async fn get(&self, id: Uuid) -> Result<Webhook, ServiceError> {
        let stored = self.store.webhook(id).await?;
        stored.map(|stored| stored.webhook).ok_or_else(|| no_webhook(id))
    }

    /// Deletes a webhook with its deliveries. An attempt in progress is not aborted.
    pub async fn delete(&self, id: Uuid) -> Result<(), ServiceError> {
        if !self.store.delete_webhook(id).await? {
            return Err(no_webhook(id));
        }
        tracing::info!(target: "audit", deleted = %id, "a webhook was deleted");
        Ok(())
    }

    /// Queues a ping message to a webhook.
    pub async fn test(&self, id: Uuid) -> Result<Delivery, ServiceError> {
        let (webhook, now) = (self.get(id).await?, Timestamp::now());
        let message = Message { event: WebhookEvent::Ping, timestamp: now, data: &webhook };
        let body = serde_json::to_vec(&message)
            .map_err(|error| ServiceError::new(ErrorKind::Internal, error.to_string()))?;
        let delivery = Delivery::queued(id, WebhookEvent::Ping, None, now);
        self.store.queue_delivery(StoredDelivery { delivery: delivery.clone(), body }).await?;
        Ok(delivery)
    }

    /// Returns a page of the deliveries of a webhook, newest first.
    pub async fn deliveries(
        &self,
        id: Uuid,
        state: Option<DeliveryState>,
        cursor: Option<Uuid>,
        limit: Option<usize>,
    ) -> Result<DeliveryPage, ServiceError> {
        let limit = page_size(limit)?;
        self.get(id).await?;
        let mut deliveries = self.store.deliveries(id, state, cursor, limit + 1).await?;
        let more = deliveries.len() > limit;
        deliveries.truncate(limit);
        let next_cursor = deliveries.last().filter(|_| more).map(|delivery| delivery.id);
        Ok(DeliveryPage { deliveries, next_cursor })
    }

    /// Queues a delivery again that has ended, with no attempts counted.
    pub async fn redeliver(&self, id: Uuid, delivery: Uuid) -> Result<Delivery, ServiceError> {
        Ok(self.store.queue_again(id, delivery, Timestamp::now()).await?)
    }
}

fn no_webhook(id: Uuid) -> ServiceError {
    ServiceError::not_found(format!("there is no webhook {id}; GET /webhooks lists all webhooks"))
}
