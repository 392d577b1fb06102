//! The records that deliveries leave in the database. `tests/store/webhooks.rs` tests their behaviour,
//! for every store.

use jiff::Timestamp;
use uuid::Uuid;

use super::super::test_records::settings;
use super::*;
use whereabouts_core::{Disposition, Webhook, WebhookEvent, WebhookSecret};

/// Adds a webhook with a number of waiting pings.
async fn pinged(store: &EmbeddedStore, pings: usize) -> (Uuid, Vec<Uuid>) {
    let webhook = Webhook {
        id: Uuid::now_v7(),
        url: "https://a.example/".into(),
        events: WebhookEvent::ENDS.to_vec(),
        map: None,
        created_at: Timestamp::now(),
        disabled_at: None,
        disabled_reason: None,
    };
    let (id, secret) = (webhook.id, WebhookSecret::new(&[1; 32]));
    store.add_webhook(StoredWebhook { webhook, secret }, 10).await.unwrap();
    let mut ids = Vec::new();
    for _ in 0..pings {
        let delivery = Delivery::queued(id, WebhookEvent::Ping, None, Timestamp::now());
        ids.push(delivery.id);
        store.queue_delivery(StoredDelivery { delivery, body: b"{}".to_vec() }).await.unwrap();
    }
    (id, ids)
}

#[tokio::test]
async fn a_removed_delivery_leaves_no_records() {
    let dir = tempfile::tempdir().unwrap();
    let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
    let (deleted, pings) = pinged(&store, REMOVAL_BATCH + 3).await;
    pinged(&store, 3).await;
    let at = Timestamp::now();
    let dead = Attempt { at, status: None, error: None, disposition: Disposition::Dead };
    store.note_attempt(deleted, pings[0], dead).await.unwrap();
    assert!(store.delete_webhook(deleted).await.unwrap());
    let assert_remaining = |count: usize| {
        let trees = &store.inner.trees.webhooks;
        for tree in [&trees.deliveries, &trees.bodies, &trees.due] {
            assert_eq!(tree.len(), count);
        }
        assert_eq!(trees.ended.len(), 0);
    };
    assert_remaining(3);
    store.forget_deliveries(DeliveryRetention { since: None, most: 1 }, 9).await.unwrap();
    assert_remaining(1);
}
