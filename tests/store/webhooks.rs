//! Webhooks and their deliveries.

use std::sync::Arc;

use futures_util::future::join_all;
use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;
use whereabouts_core::{
    Attempt, Delivery, DeliveryState, Disposition, Job, JobState, StoredWebhook, Webhook,
    WebhookEvent, WebhookSecret,
};
use whereabouts_store::{DeliveryRetention, RemovedDeliveries, Store, StoreError, StoredDelivery};

use crate::support::{Fixture, claim, eventually, odd_texts, submit};

contract!(
    webhooks_are_listed_oldest_first_and_bounded_in_number,
    the_end_of_a_job_is_queued_for_the_webhooks_subscribed_at_that_time,
    a_delivery_is_due_at_its_time_until_it_has_ended,
    a_retried_delivery_is_due_at_its_next_attempt,
    a_webhook_is_deleted_with_its_deliveries_and_a_disabled_one_gets_none,
    ended_deliveries_are_evicted_before_waiting_ones,
    a_queued_delivery_is_notified,
    a_delivery_of_a_process_that_ended_is_due_again,
    an_unknown_webhook_or_delivery_is_not_found,
    odd_texts_in_a_delivery_survive,
);

async fn webhook(store: &dyn Store, events: &[WebhookEvent], map: Option<&str>) -> Uuid {
    let stored = new_webhook(events, map);
    let id = stored.webhook.id;
    store.add_webhook(stored, 10).await.unwrap();
    id
}

fn new_webhook(events: &[WebhookEvent], map: Option<&str>) -> StoredWebhook {
    let webhook = Webhook {
        id: Uuid::now_v7(),
        url: "https://a.example/?\"'é".into(),
        events: events.to_vec(),
        map: map.map(|map| map.parse().unwrap()),
        created_at: Timestamp::now(),
        disabled_at: None,
        disabled_reason: None,
    };
    StoredWebhook { webhook, secret: WebhookSecret::new(&[1; 32]) }
}

/// A job that ended in this state.
async fn ended(store: &dyn Store, map: &str, state: JobState) -> Uuid {
    submit(store, map, b"frame").await;
    end(store, state).await
}

async fn end(store: &dyn Store, state: JobState) -> Uuid {
    let claimed = claim(store).await.unwrap();
    let job = Job { state, finished_at: Some(Timestamp::now()), ..claimed.job.clone() };
    store.finish(claimed.claim(), job).await.unwrap();
    claimed.job.id
}

async fn listed(store: &dyn Store, webhook: Uuid) -> Vec<Delivery> {
    store.deliveries(webhook, None, None, 1000).await.unwrap()
}

async fn due(store: &dyn Store, webhook: Uuid, at: Timestamp) -> Vec<Uuid> {
    let due = store.due_deliveries(webhook, at, 100).await.unwrap();
    due.into_iter().map(|due| due.delivery.id).collect()
}

fn attempt(at: Timestamp, disposition: Disposition) -> Attempt {
    Attempt { at, status: None, error: None, disposition }
}

fn ping(webhook: Uuid) -> StoredDelivery {
    let delivery = Delivery::queued(webhook, WebhookEvent::Ping, None, Timestamp::now());
    StoredDelivery { delivery, body: b"{}".to_vec() }
}

/// A webhook with this many waiting pings.
async fn pinged(store: &dyn Store, pings: usize) -> (Uuid, Vec<Uuid>) {
    let id = webhook(store, &WebhookEvent::ENDS, None).await;
    let mut ids = Vec::new();
    for _ in 0..pings {
        let ping = ping(id);
        ids.push(ping.delivery.id);
        store.queue_delivery(ping).await.unwrap();
    }
    (id, ids)
}

async fn webhooks_are_listed_oldest_first_and_bounded_in_number(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut known: Vec<_> = (0..3).map(|_| new_webhook(&[WebhookEvent::JobFailed], None)).collect();
    for webhook in [1, 0, 2] {
        store.add_webhook(known[webhook].clone(), 10).await.unwrap();
    }
    assert_eq!(store.webhooks().await.unwrap(), known);
    let (at, odd) = (Timestamp::now(), odd_texts().concat());
    store.disable_webhook(known[1].webhook.id, at, &odd).await.unwrap();
    store.disable_webhook(known[1].webhook.id, Timestamp::now(), "again").await.unwrap();
    store.disable_webhook(Uuid::now_v7(), at, "nobody").await.unwrap();
    known[1].webhook.disabled_at = Some(at);
    known[1].webhook.disabled_reason = Some(odd);
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.webhooks().await.unwrap(), known);
    for stored in &known {
        assert_eq!(store.webhook(stored.webhook.id).await.unwrap().as_ref(), Some(stored));
    }
    assert_eq!(store.webhook(Uuid::now_v7()).await.unwrap(), None);
    let adding = (0..8).map(|_| {
        let store = Arc::clone(&store);
        tokio::spawn(async move { store.add_webhook(new_webhook(&[], None), 5).await })
    });
    let added: Vec<_> = join_all(adding).await.into_iter().map(Result::unwrap).collect();
    assert_eq!(added.iter().filter(|added| added.is_ok()).count(), 2);
    let refused = added.into_iter().find_map(Result::err).unwrap();
    assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
}

async fn the_end_of_a_job_is_queued_for_the_webhooks_subscribed_at_that_time(fixture: &Fixture) {
    let store = fixture.open().await;
    let early = ended(&*store, "yard", JobState::Failed).await;
    let all = webhook(&*store, &WebhookEvent::ENDS, None).await;
    let failures = webhook(&*store, &[WebhookEvent::JobFailed], Some("yard")).await;
    let elsewhere = webhook(&*store, &WebhookEvent::ENDS, Some("vault")).await;
    let good = ended(&*store, "yard", JobState::Succeeded).await;
    let bad = ended(&*store, "yard", JobState::Failed).await;
    drop(store);

    let store = fixture.open().await;
    let jobs = |deliveries: Vec<Delivery>| -> Vec<Uuid> {
        deliveries.iter().map(|delivery| delivery.job.unwrap()).collect()
    };
    assert_eq!(jobs(listed(&*store, all).await), [bad, good]);
    assert_eq!(jobs(listed(&*store, failures).await), [bad]);
    assert!(listed(&*store, elsewhere).await.is_empty());
    // A job that ends again is delivered again.
    store.retry(early, None).await.unwrap();
    assert_eq!(end(&*store, JobState::Degraded).await, early);
    assert_eq!(jobs(listed(&*store, all).await), [early, bad, good]);
    let due = store.due_deliveries(all, Timestamp::now(), 9).await.unwrap();
    let message: serde_json::Value = serde_json::from_slice(&due[2].body).unwrap();
    assert_eq!(
        (&message["type"], &message["data"]["id"]),
        (&"job.degraded".into(), &early.to_string().into())
    );
    let job = store.job(early).await.unwrap().unwrap().job;
    assert_eq!(message["data"], serde_json::to_value(job).unwrap());
    // A job is delivered once, however often it is cancelled.
    store.retry(bad, None).await.unwrap();
    store.cancel(bad).await.unwrap();
    store.cancel(bad).await.unwrap();
    assert_eq!(listed(&*store, all).await.len(), 4);
    assert_eq!(listed(&*store, all).await[0].event, WebhookEvent::JobCancelled);
}

async fn a_delivery_is_due_at_its_time_until_it_has_ended(fixture: &Fixture) {
    let store = fixture.open().await;
    let (id, pings) = pinged(&*store, 3).await;
    let now = Timestamp::now();
    assert!(due(&*store, id, now - SignedDuration::from_secs(60)).await.is_empty());
    assert_eq!(due(&*store, id, now).await, pings);
    assert_eq!(store.due_deliveries(id, now, 2).await.unwrap().len(), 2);
    let later = now + SignedDuration::from_secs(60);
    let note = |ping: usize, disposition: Disposition| {
        store.note_attempt(id, pings[ping], attempt(now, disposition))
    };
    note(0, Disposition::RetryAt(later)).await.unwrap().unwrap();
    note(1, Disposition::Delivered).await.unwrap().unwrap();
    assert_eq!(due(&*store, id, now).await, [pings[2]]);
    assert_eq!(due(&*store, id, later).await, [pings[2], pings[0]]);
    assert_eq!(store.waiting_deliveries().await.unwrap(), 2);
    // It has been delivered; a late outcome changes nothing.
    let late = attempt(later, Disposition::Dead);
    assert_eq!(store.note_attempt(id, pings[1], late).await.unwrap(), None);
    let again = store.queue_again(id, pings[0], now).await.unwrap_err().to_string();
    assert!(again.contains("waits anyway"), "{again}");
    assert_eq!(store.queue_again(id, pings[1], now).await.unwrap().attempts, 0);
    assert!(due(&*store, id, now).await.contains(&pings[1]));
    let waiting = Some(DeliveryState::Waiting);
    assert_eq!(store.deliveries(id, waiting, None, 9).await.unwrap().len(), 3);
    let page = store.deliveries(id, waiting, Some(pings[1]), 9).await.unwrap();
    assert_eq!(page.iter().map(|delivery| delivery.id).collect::<Vec<_>>(), [pings[0]]);
    assert_eq!(store.deliveries(id, None, None, 1).await.unwrap()[0].id, pings[2]);
    // A delivery that was given up may have arrived all the same.
    note(2, Disposition::Dead).await.unwrap().unwrap();
    let arrived = attempt(later, Disposition::Delivered);
    let after = store.note_attempt(id, pings[2], arrived).await.unwrap().unwrap();
    assert_eq!((after.state, after.attempts), (DeliveryState::Delivered, 2));
}

async fn a_retried_delivery_is_due_at_its_next_attempt(fixture: &Fixture) {
    let store = fixture.open().await;
    let (id, pings) = pinged(&*store, 1).await;
    for tries in 1..4 {
        assert_eq!(due(&*store, id, Timestamp::now()).await, pings);
        let now = Timestamp::now();
        let failed = Attempt {
            status: Some(503),
            error: Some("busy".into()),
            ..attempt(now, Disposition::RetryAt(now + SignedDuration::from_millis(100)))
        };
        let noted = store.note_attempt(id, pings[0], failed.clone()).await.unwrap().unwrap();
        assert_eq!((noted.attempts, noted.last_status), (tries, Some(503)));
        // Recorded again, after a call whose answer was lost, it counts once.
        assert_eq!(store.note_attempt(id, pings[0], failed).await.unwrap(), Some(noted.clone()));
        assert_eq!(listed(&*store, id).await, [noted]);
        assert!(due(&*store, id, now).await.is_empty());
        eventually(async || {
            let due = due(&*store, id, Timestamp::now()).await;
            (due == pings).then_some(())
        })
        .await;
    }
}

async fn a_webhook_is_deleted_with_its_deliveries_and_a_disabled_one_gets_none(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    // More than one step of the sweep removes.
    let (gone, pings) = pinged(store, 259).await;
    let (stays, _) = pinged(store, 2).await;
    let now = Timestamp::now();
    store.note_attempt(gone, pings[0], attempt(now, Disposition::Dead)).await.unwrap();
    assert!(store.delete_webhook(gone).await.unwrap());
    assert!(!store.delete_webhook(gone).await.unwrap());
    assert!(listed(store, gone).await.is_empty());
    assert_eq!(
        store.note_attempt(gone, pings[1], attempt(now, Disposition::Dead)).await.unwrap(),
        None
    );
    assert_eq!(store.waiting_deliveries().await.unwrap(), 2);
    store.disable_webhook(stays, now, "gone").await.unwrap();
    ended(store, "yard", JobState::Failed).await;
    assert_eq!(listed(store, stays).await.len(), 2);
    let refused = store.queue_delivery(ping(stays)).await.unwrap_err();
    assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    assert_eq!(store.give_up_deliveries(stays, now, "disabled", 1).await.unwrap(), 1);
    assert_eq!(store.give_up_deliveries(stays, now, "disabled", 9).await.unwrap(), 1);
    assert_eq!(store.give_up_deliveries(stays, now, "disabled", 9).await.unwrap(), 0);
    let dead = listed(store, stays).await[0].clone();
    assert_eq!((dead.state, dead.last_error.as_deref()), (DeliveryState::Dead, Some("disabled")));
    let refused = store.queue_again(stays, dead.id, now).await.unwrap_err().to_string();
    assert!(refused.contains("disabled (gone)"), "{refused}");
}

async fn ended_deliveries_are_evicted_before_waiting_ones(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    let (id, pings) = pinged(store, 6).await;
    let now = Timestamp::now();
    let day = SignedDuration::from_hours(24);
    for (ping, days) in [(4, 1), (2, 3), (3, 40)] {
        let ended = now - day * days;
        store.note_attempt(id, pings[ping], attempt(ended, Disposition::Dead)).await.unwrap();
    }
    let left = async || -> Vec<Uuid> {
        let mut ids: Vec<_> = listed(store, id).await.iter().map(|left| left.id).collect();
        ids.reverse();
        ids
    };
    let keep = DeliveryRetention { since: Some(now - day * 30), most: 100 };
    let forgotten = store.forget_deliveries(keep, 9).await.unwrap();
    assert_eq!(forgotten, RemovedDeliveries { ended: 1, waiting: 0 });
    let keep = DeliveryRetention { since: None, most: 4 };
    assert_eq!(store.forget_deliveries(keep, 9).await.unwrap().ended, 1);
    assert_eq!(left().await, [pings[0], pings[1], pings[4], pings[5]]);
    let keep = DeliveryRetention { since: None, most: 1 };
    let forgotten = store.forget_deliveries(keep, 1).await.unwrap();
    assert_eq!(forgotten, RemovedDeliveries { ended: 1, waiting: 0 });
    let forgotten = store.forget_deliveries(keep, 9).await.unwrap();
    assert_eq!(forgotten, RemovedDeliveries { ended: 0, waiting: 2 });
    assert_eq!(left().await, [pings[5]]);
    assert_eq!(store.forget_deliveries(keep, 9).await.unwrap(), RemovedDeliveries::default());
}

async fn a_queued_delivery_is_notified(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = webhook(&*store, &WebhookEvent::ENDS, None).await;
    let mut queued = store.queued_deliveries();
    let mut notified = async || {
        let timeout = std::time::Duration::from_secs(20);
        tokio::time::timeout(timeout, queued.changed()).await.unwrap().unwrap();
    };
    let ping = ping(id);
    let delivery = ping.delivery.id;
    store.queue_delivery(ping).await.unwrap();
    notified().await;
    ended(&*store, "yard", JobState::Failed).await;
    notified().await;
    let now = Timestamp::now();
    store.note_attempt(id, delivery, attempt(now, Disposition::Dead)).await.unwrap();
    store.queue_again(id, delivery, now).await.unwrap();
    notified().await;
}

async fn a_delivery_of_a_process_that_ended_is_due_again(fixture: &Fixture) {
    let store = fixture.open().await;
    let (id, pings) = pinged(&*store, 2).await;
    assert_eq!(due(&*store, id, Timestamp::now()).await, pings);
    drop(store);
    let store = fixture.open().await;
    let mut taken = Vec::new();
    while taken.len() < 2 {
        taken = eventually(async || {
            let due = due(&*store, id, Timestamp::now()).await;
            (!due.is_empty()).then_some(due)
        })
        .await;
    }
    assert_eq!(taken, pings);
}

async fn an_unknown_webhook_or_delivery_is_not_found(fixture: &Fixture) {
    let store = fixture.open().await;
    let (id, _) = pinged(&*store, 1).await;
    let (gone, now) = (Uuid::now_v7(), Timestamp::now());
    for refused in [
        store.queue_delivery(ping(gone)).await,
        store.queue_again(gone, gone, now).await.map(drop),
        store.queue_again(id, gone, now).await.map(drop),
    ] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, StoreError::NotFound(_)), "{refused}");
    }
    assert_eq!(store.note_attempt(id, gone, attempt(now, Disposition::Dead)).await.unwrap(), None);
    assert!(due(&*store, gone, now).await.is_empty() && listed(&*store, gone).await.is_empty());
    assert_eq!(store.give_up_deliveries(gone, now, "", 9).await.unwrap(), 0);
}

async fn odd_texts_in_a_delivery_survive(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = webhook(&*store, &[], None).await;
    for text in odd_texts() {
        let body = [text.as_bytes(), &[0, 255]].concat();
        let delivery = StoredDelivery { body, ..ping(id) };
        store.queue_delivery(delivery.clone()).await.unwrap();
        let now = Timestamp::now();
        let due = store.due_deliveries(id, now, 9).await.unwrap();
        assert_eq!(due, std::slice::from_ref(&delivery));
        let failed = Attempt { error: Some(text.clone()), ..attempt(now, Disposition::Dead) };
        store.note_attempt(id, delivery.delivery.id, failed).await.unwrap();
        let listed = &store.deliveries(id, None, None, 1).await.unwrap()[0];
        assert_eq!(listed.last_error.as_ref(), Some(&text));
        assert_eq!(listed.ended_at, Some(now));
    }
}
