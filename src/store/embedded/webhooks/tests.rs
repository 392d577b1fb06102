//! What deliveries leave in the database. What they mean is in `tests/store/webhooks.rs`, for every store.

use jiff::Timestamp;
use uuid::Uuid;

use super::super::drafts::tests::settings;
use super::*;
use whereabouts_core::{Disposition, Webhook, WebhookEvent, WebhookSecret};

/// A webhook of which so many pings wait.
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
async fn nothing_is_left_of_deliveries_that_are_gone() {
    let dir = tempfile::tempdir().unwrap();
    let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
    let (gone, pings) = pinged(&store, REMOVED_AT_ONCE + 3).await;
    pinged(&store, 3).await;
    let at = Timestamp::now();
    let dead = Attempt { at, status: None, error: None, disposition: Disposition::Dead };
    store.note_attempt(gone, pings[0], dead).await.unwrap();
    assert!(store.delete_webhook(gone).await.unwrap());
    let left = |count: usize| {
        let trees = &store.inner.trees.webhooks;
        for tree in [&trees.deliveries, &trees.bodies, &trees.due] {
            assert_eq!(tree.len(), count);
        }
        assert_eq!(trees.ended.len(), 0);
    };
    left(3);
    store.forget_deliveries(KeepDeliveries { since: None, most: 1 }, 9).await.unwrap();
    left(1);
}
