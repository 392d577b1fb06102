use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;

use super::super::drafts::tests::settings;
use super::*;
use crate::domain::{
    Digest, Job, JobState, MediaType, RefinerKind, Webhook, WebhookEvent, WebhookSecret,
};
use crate::store::{JobRecord, JobStore, Query};

fn store() -> (tempfile::TempDir, EmbeddedStore) {
    let dir = tempfile::tempdir().unwrap();
    let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
    (dir, store)
}

async fn webhook(store: &EmbeddedStore, events: &[WebhookEvent], map: Option<&str>) -> Uuid {
    let webhook = Webhook {
        id: Uuid::now_v7(),
        url: "https://a.example/".into(),
        events: events.to_vec(),
        map: map.map(|map| map.parse().unwrap()),
        created_at: Timestamp::now(),
        disabled_at: None,
        disabled_reason: None,
    };
    let (id, secret) = (webhook.id, WebhookSecret::new(&[1; 32]));
    store.add_webhook(StoredWebhook { webhook, secret }, 10).await.unwrap();
    id
}

/// A job that ended so.
async fn ended(store: &EmbeddedStore, map: &str, state: JobState) -> Uuid {
    let (now, id) = (Timestamp::now(), Uuid::now_v7());
    let digest = Digest::of(b"frame");
    let query =
        Query { id, digest, media_type: MediaType::Jpeg, created_at: now, descriptor: None };
    let job = Job::queued(map.parse().unwrap(), id, RefinerKind::Local, now);
    let (map_uid, candidates) = (Uuid::nil(), vec![]);
    let record =
        JobRecord { job, map_uid, revision: 0, query, candidates, claims: 0, traceparent: None };
    store.submit(record, 100).await.unwrap();
    end(store, state).await
}

async fn end(store: &EmbeddedStore, state: JobState) -> Uuid {
    let now = Timestamp::now();
    let claimed = store.claim(now, now).await.unwrap().unwrap();
    let job = Job { state, finished_at: Some(now), ..claimed.job.clone() };
    store.finish(claimed.claim(), job).await.unwrap();
    claimed.job.id
}

async fn listed(store: &EmbeddedStore, webhook: Uuid) -> Vec<Delivery> {
    store.deliveries(webhook, None, None, 100).await.unwrap()
}

async fn due(store: &EmbeddedStore, webhook: Uuid, at: Timestamp) -> Vec<Uuid> {
    let due = store.due_deliveries(webhook, at, 100).await.unwrap();
    due.into_iter().map(|due| due.delivery.id).collect()
}

fn attempt(at: Timestamp, then: Then) -> Attempt {
    Attempt { at, status: None, error: None, then }
}

/// A webhook of which so many pings wait.
async fn pinged(store: &EmbeddedStore, pings: usize) -> (Uuid, Vec<Uuid>) {
    let id = webhook(store, &WebhookEvent::ENDS, None).await;
    let mut ids = Vec::new();
    for _ in 0..pings {
        let delivery = Delivery::queued(id, WebhookEvent::Ping, None, Timestamp::now());
        ids.push(delivery.id);
        store.queue_delivery(StoredDelivery { delivery, body: b"{}".to_vec() }).await.unwrap();
    }
    (id, ids)
}

#[tokio::test]
async fn the_end_of_a_job_is_queued_for_whom_it_concerns_and_for_nobody_who_came_later() {
    let (dir, store) = store();
    let early = ended(&store, "yard", JobState::Failed).await;
    let all = webhook(&store, &WebhookEvent::ENDS, None).await;
    let failures = webhook(&store, &[WebhookEvent::JobFailed], Some("yard")).await;
    let elsewhere = webhook(&store, &WebhookEvent::ENDS, Some("vault")).await;
    let good = ended(&store, "yard", JobState::Succeeded).await;
    let bad = ended(&store, "yard", JobState::Failed).await;
    drop(store);

    let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
    let jobs = |deliveries: Vec<Delivery>| -> Vec<Uuid> {
        deliveries.iter().map(|delivery| delivery.job.unwrap()).collect()
    };
    assert_eq!(jobs(listed(&store, all).await), [bad, good]);
    assert_eq!(jobs(listed(&store, failures).await), [bad]);
    assert!(listed(&store, elsewhere).await.is_empty());
    // One that ends again is news again.
    store.retry(early).await.unwrap();
    assert_eq!(end(&store, JobState::Degraded).await, early);
    assert_eq!(jobs(listed(&store, all).await), [early, bad, good]);
    let due = store.due_deliveries(all, Timestamp::now(), 9).await.unwrap();
    let message: serde_json::Value = serde_json::from_slice(&due[2].body).unwrap();
    assert_eq!(
        (&message["type"], &message["data"]["id"]),
        (&"job.degraded".into(), &early.to_string().into())
    );
    let job = store.job(early).await.unwrap().unwrap().job;
    assert_eq!(message["data"], serde_json::to_value(job).unwrap());
    // A cancelled one is told once, however often it is cancelled.
    store.retry(bad).await.unwrap();
    store.cancel(bad).await.unwrap();
    store.cancel(bad).await.unwrap();
    assert_eq!(listed(&store, all).await.len(), 4);
    assert_eq!(listed(&store, all).await[0].event, WebhookEvent::JobCancelled);
}

#[tokio::test]
async fn a_delivery_is_due_at_its_time_until_it_has_ended() {
    let (_dir, store) = store();
    let (id, pings) = pinged(&store, 3).await;
    let now = Timestamp::now();
    assert_eq!(due(&store, id, now).await, pings);
    assert_eq!(store.due_deliveries(id, now, 2).await.unwrap().len(), 2);
    let later = now + SignedDuration::from_secs(60);
    let note = |ping: usize, then: Then| store.note_attempt(id, pings[ping], attempt(now, then));
    note(0, Then::Again(later)).await.unwrap().unwrap();
    note(1, Then::Delivered).await.unwrap().unwrap();
    assert_eq!(due(&store, id, now).await, [pings[2]]);
    assert_eq!(due(&store, id, later).await, [pings[2], pings[0]]);
    assert_eq!(store.waiting_deliveries().await.unwrap(), 2);
    // It has been delivered; what comes late changes nothing.
    assert_eq!(note(1, Then::Dead).await.unwrap(), None);
    let again = store.queue_again(id, pings[0], now).await.unwrap_err().to_string();
    assert!(again.contains("waits anyway"), "{again}");
    assert_eq!(store.queue_again(id, pings[1], now).await.unwrap().attempts, 0);
    assert!(due(&store, id, now).await.contains(&pings[1]));
    let waiting = Some(DeliveryState::Waiting);
    assert_eq!(store.deliveries(id, waiting, None, 9).await.unwrap().len(), 3);
    let page = store.deliveries(id, waiting, Some(pings[1]), 9).await.unwrap();
    assert_eq!(page.iter().map(|delivery| delivery.id).collect::<Vec<_>>(), [pings[0]]);
}

#[tokio::test]
async fn a_webhook_goes_with_its_deliveries_and_a_disabled_one_takes_none() {
    let (_dir, store) = store();
    let (gone, pings) = pinged(&store, REMOVED_AT_ONCE + 3).await;
    let (stays, _) = pinged(&store, 2).await;
    let now = Timestamp::now();
    store.note_attempt(gone, pings[0], attempt(now, Then::Dead)).await.unwrap();
    assert!(store.delete_webhook(gone).await.unwrap());
    assert!(!store.delete_webhook(gone).await.unwrap());
    assert!(listed(&store, gone).await.is_empty());
    assert_eq!(store.note_attempt(gone, pings[1], attempt(now, Then::Dead)).await.unwrap(), None);
    let trees = &store.inner.trees.webhooks;
    for (tree, left) in
        [(&trees.deliveries, 2), (&trees.bodies, 2), (&trees.due, 2), (&trees.ended, 0)]
    {
        assert_eq!(tree.len(), left);
    }
    store.disable_webhook(stays, now, "gone").await.unwrap();
    ended(&store, "yard", JobState::Failed).await;
    assert_eq!(listed(&store, stays).await.len(), 2);
    assert_eq!(store.give_up_deliveries(stays, now, "disabled", 1).await.unwrap(), 1);
    assert_eq!(store.give_up_deliveries(stays, now, "disabled", 9).await.unwrap(), 1);
    assert_eq!(store.give_up_deliveries(stays, now, "disabled", 9).await.unwrap(), 0);
    let dead = listed(&store, stays).await[0].clone();
    assert_eq!((dead.state, dead.last_error.as_deref()), (DeliveryState::Dead, Some("disabled")));
    let refused = store.queue_again(stays, dead.id, now).await.unwrap_err().to_string();
    assert!(refused.contains("disabled (gone)"), "{refused}");
}

#[tokio::test]
async fn the_first_to_end_are_forgotten_and_what_waits_only_if_there_is_no_other_way() {
    let (_dir, store) = store();
    let (id, pings) = pinged(&store, 6).await;
    let now = Timestamp::now();
    let day = SignedDuration::from_hours(24);
    for (ping, days) in [(4, 1), (2, 3), (3, 40)] {
        let ended = now - day * days;
        store.note_attempt(id, pings[ping], attempt(ended, Then::Dead)).await.unwrap();
    }
    let left = async || -> Vec<Uuid> {
        let mut ids: Vec<_> = listed(&store, id).await.iter().map(|left| left.id).collect();
        ids.reverse();
        ids
    };
    let keep = KeepDeliveries { since: Some(now - day * 30), most: 100 };
    let forgotten = store.forget_deliveries(keep, 9).await.unwrap();
    assert_eq!(forgotten, ForgottenDeliveries { ended: 1, waiting: 0 });
    let keep = KeepDeliveries { since: None, most: 4 };
    assert_eq!(store.forget_deliveries(keep, 9).await.unwrap().ended, 1);
    assert_eq!(left().await, [pings[0], pings[1], pings[4], pings[5]]);
    let keep = KeepDeliveries { since: None, most: 1 };
    let forgotten = store.forget_deliveries(keep, 9).await.unwrap();
    assert_eq!(forgotten, ForgottenDeliveries { ended: 1, waiting: 2 });
    assert_eq!(left().await, [pings[5]]);
    assert_eq!(store.forget_deliveries(keep, 9).await.unwrap(), ForgottenDeliveries::default());
    assert_eq!(store.inner.trees.webhooks.bodies.len(), 1);
}
