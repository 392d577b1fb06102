//! The records of webhooks in sled and their keys.

use jiff::Timestamp;
use sled::Transactional;
use sled::transaction::{ConflictableTransactionResult, TransactionalTree};
use uuid::Uuid;

use super::super::super::changes::{check_enabled, deliveries_for, no_webhook};
use super::super::super::{DeliveryRetention, StoreError};
use super::super::records::{decode, encode, failed, get, transaction_failed};
use whereabouts_core::{Delivery, DeliveryState, Job, StoredWebhook};

/// The sled trees of webhooks.
#[derive(Clone)]
pub(in super::super) struct WebhookTrees {
    /// Id → webhook.
    pub webhooks: sled::Tree,
    /// Webhook, id → delivery.
    pub deliveries: sled::Tree,
    /// Webhook, id → the body of the message.
    pub bodies: sled::Tree,
    /// Webhook, due time, id → nothing, for waiting deliveries.
    pub due: sled::Tree,
    /// End time, webhook, id → nothing, for all other deliveries.
    pub ended: sled::Tree,
}

impl WebhookTrees {
    pub fn open(db: &sled::Db) -> Result<Self, StoreError> {
        let tree = |name: &str| db.open_tree(name).map_err(failed);
        Ok(Self {
            webhooks: tree("webhooks")?,
            deliveries: tree("deliveries")?,
            bodies: tree("delivery_bodies")?,
            due: tree("deliveries_due")?,
            ended: tree("deliveries_ended")?,
        })
    }

    pub fn webhook(&self, id: Uuid) -> Result<Option<StoredWebhook>, StoreError> {
        get(&self.webhooks, id.as_bytes())
    }

    pub fn delivery(&self, key: &[u8]) -> Result<Option<Delivery>, StoreError> {
        get(&self.deliveries, key)
    }

    /// Refuses a webhook that does not exist or is disabled.
    pub fn enabled(&self, id: Uuid) -> Result<(), StoreError> {
        check_enabled(&self.webhook(id)?.ok_or_else(|| no_webhook(id))?)
    }

    /// Returns the deliveries to write because a job has ended.
    pub fn deliveries_for(&self, job: &Job) -> Result<Vec<DeliveryRecord>, StoreError> {
        if self.webhooks.is_empty() {
            return Ok(Vec::new());
        }
        let webhooks = self.webhooks.iter().values().map(|value| decode(&value.map_err(failed)?));
        let outbox = deliveries_for(job, webhooks.collect::<Result<Vec<_>, _>>()?)?;
        outbox.into_iter().map(|new| DeliveryRecord::new(&new.delivery, new.body)).collect()
    }

    pub fn queue(&self, new: &DeliveryRecord) -> Result<(), StoreError> {
        (&self.deliveries, &self.bodies, &self.due)
            .transaction(|(deliveries, bodies, due)| new.write(deliveries, bodies, due))
            .map_err(transaction_failed)
    }

    /// Replaces a delivery with its new state.
    pub fn replace(&self, before: &Delivery, after: &Delivery) -> Result<(), StoreError> {
        let (key, value) = (key(after.webhook, after.id), encode(after)?);
        (&self.deliveries, &self.due, &self.ended)
            .transaction(|(deliveries, due, ended)| {
                due.remove(due_key(before))?;
                ended.remove(ended_key(before))?;
                match after.state {
                    DeliveryState::Waiting => due.insert(due_key(after), &[])?,
                    _ => ended.insert(ended_key(after), &[])?,
                };
                deliveries.insert(&key, value.as_slice())?;
                Ok(())
            })
            .map_err(transaction_failed)
    }

    pub fn remove(&self, delivery: &Delivery) -> Result<(), StoreError> {
        let key = key(delivery.webhook, delivery.id);
        (&self.deliveries, &self.bodies, &self.due, &self.ended)
            .transaction(|(deliveries, bodies, due, ended)| {
                due.remove(due_key(delivery))?;
                ended.remove(ended_key(delivery))?;
                bodies.remove(&key)?;
                deliveries.remove(&key)?;
                Ok(())
            })
            .map_err(transaction_failed)
    }

    /// Returns up to `limit` deliveries of a webhook.
    pub fn some_of(&self, webhook: Uuid, limit: usize) -> Result<Vec<Delivery>, StoreError> {
        let values = self.deliveries.scan_prefix(webhook.as_bytes()).values();
        values.take(limit).map(|value| decode(&value.map_err(failed)?)).collect()
    }

    /// Returns the keys of waiting deliveries that are due by `until`, in order of due time.
    pub fn due_until(
        &self,
        webhook: Uuid,
        until: Timestamp,
        limit: usize,
    ) -> Result<Vec<[u8; 32]>, StoreError> {
        let end = [&webhook.as_bytes()[..], &millis(until), &[u8::MAX; 16]].concat();
        let due_keys = self.due.range(webhook.as_bytes().to_vec()..=end).keys();
        let mut keys = Vec::new();
        for due_key in due_keys.take(limit) {
            keys.extend(key_within(&due_key.map_err(failed)?, 0, 24));
        }
        Ok(keys)
    }

    /// Returns the keys of up to `batch` deliveries that need not be kept.
    pub fn surplus(
        &self,
        keep: DeliveryRetention,
        batch: usize,
    ) -> Result<Vec<[u8; 32]>, StoreError> {
        let excess = self.deliveries.len().saturating_sub(keep.most);
        let since = millis(keep.since.unwrap_or(Timestamp::UNIX_EPOCH));
        let mut keys = Vec::new();
        for ended_key in self.ended.iter().keys() {
            let ended_key = ended_key.map_err(failed)?;
            if keys.len() >= batch || (keys.len() >= excess && ended_key[..] >= since[..]) {
                return Ok(keys);
            }
            keys.extend(key_within(&ended_key, 8, 24));
        }
        if keys.len() < excess {
            let mut waiting = Vec::new();
            for due_key in self.due.iter().keys() {
                waiting.extend(key_within(&due_key.map_err(failed)?, 0, 24));
            }
            // Ids sort by age.
            waiting.sort_by(|a, b| a[16..].cmp(&b[16..]));
            let remaining = excess.min(batch) - keys.len();
            keys.extend(waiting.into_iter().take(remaining));
        }
        Ok(keys)
    }
}

/// A new delivery, encoded for writing.
pub(in super::super) struct DeliveryRecord {
    key: [u8; 32],
    due: Vec<u8>,
    delivery: Vec<u8>,
    body: Vec<u8>,
}

impl DeliveryRecord {
    pub fn new(delivery: &Delivery, body: Vec<u8>) -> Result<Self, StoreError> {
        let key = key(delivery.webhook, delivery.id);
        Ok(Self { key, due: due_key(delivery), delivery: encode(delivery)?, body })
    }

    pub fn write(
        &self,
        deliveries: &TransactionalTree,
        bodies: &TransactionalTree,
        due: &TransactionalTree,
    ) -> ConflictableTransactionResult<(), ()> {
        deliveries.insert(&self.key, self.delivery.as_slice())?;
        bodies.insert(&self.key, self.body.as_slice())?;
        due.insert(self.due.as_slice(), &[])?;
        Ok(())
    }
}

pub(super) fn key(webhook: Uuid, id: Uuid) -> [u8; 32] {
    let mut key = [0; 32];
    key[..16].copy_from_slice(webhook.as_bytes());
    key[16..].copy_from_slice(id.as_bytes());
    key
}

/// Extracts a delivery's key from a longer key that has the webhook and the id at these offsets.
fn key_within(longer: &[u8], webhook: usize, id: usize) -> Option<[u8; 32]> {
    let mut key = [0; 32];
    key[..16].copy_from_slice(longer.get(webhook..webhook + 16)?);
    key[16..].copy_from_slice(longer.get(id..id + 16)?);
    Some(key)
}

/// Encodes a time so that bytes sort like times. Times before 1970 do not occur.
fn millis(at: Timestamp) -> [u8; 8] {
    at.as_millisecond().max(0).to_be_bytes()
}

fn due_key(delivery: &Delivery) -> Vec<u8> {
    let due = delivery.next_attempt_at.unwrap_or(delivery.created_at);
    let Delivery { webhook, id, .. } = delivery;
    [webhook.as_bytes().as_slice(), &millis(due), id.as_bytes()].concat()
}

fn ended_key(delivery: &Delivery) -> Vec<u8> {
    let ended = delivery.ended_at.unwrap_or(delivery.created_at);
    let Delivery { webhook, id, .. } = delivery;
    [&millis(ended), webhook.as_bytes().as_slice(), id.as_bytes()].concat()
}
