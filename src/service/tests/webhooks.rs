use uuid::Uuid;

use super::Fixture;
use whereabouts_api::{ErrorKind, NewWebhook};
use whereabouts_core::{DeliveryState, WebhookEvent};

fn webhook(url: &str, events: &[WebhookEvent]) -> NewWebhook {
    NewWebhook { url: url.into(), events: events.to_vec(), map: None }
}

fn public() -> NewWebhook {
    webhook("https://example.com/", &[WebhookEvent::JobSucceeded])
}

#[tokio::test]
async fn a_webhook_to_a_private_address_or_without_events_is_unprocessable() {
    let fixture = Fixture::new().await;
    for refused in [
        webhook("http://127.0.0.1/", &[WebhookEvent::JobSucceeded]),
        webhook("https://example.com/", &[]),
        webhook("https://example.com/", &[WebhookEvent::Ping]),
    ] {
        let error = fixture.service.webhooks.create(refused).await.unwrap_err();
        assert_eq!(error.kind, ErrorKind::Unprocessable);
    }
    assert!(fixture.service.webhooks.list().await.unwrap().is_empty());
}

#[tokio::test]
async fn the_number_of_webhooks_is_bounded() {
    let fixture = Fixture::with(0, |settings| settings.webhooks.max = 1).await;
    let webhooks = &fixture.service.webhooks;
    let first = webhooks.create(public()).await.unwrap().webhook;
    assert_eq!(webhooks.create(public()).await.unwrap_err().kind, ErrorKind::Conflict);
    webhooks.delete(first.id).await.unwrap();
    webhooks.create(public()).await.unwrap();
}

#[tokio::test]
async fn a_ping_is_queued_and_listed_until_the_webhook_is_deleted() {
    let fixture = Fixture::new().await;
    let webhooks = &fixture.service.webhooks;
    let id = webhooks.create(public()).await.unwrap().webhook.id;
    let pings = [webhooks.test(id).await.unwrap().id, webhooks.test(id).await.unwrap().id];
    let page = webhooks.deliveries(id, None, None, Some(1)).await.unwrap();
    assert_eq!((page.deliveries[0].id, page.deliveries[0].event), (pings[1], WebhookEvent::Ping));
    let page = webhooks.deliveries(id, None, page.next_cursor, Some(1)).await.unwrap();
    assert_eq!((page.deliveries[0].id, page.next_cursor), (pings[0], None));
    let dead = webhooks.deliveries(id, Some(DeliveryState::Dead), None, None).await.unwrap();
    assert!(dead.deliveries.is_empty());

    webhooks.delete(id).await.unwrap();
    let kinds = [
        webhooks.get(id).await.unwrap_err().kind,
        webhooks.test(id).await.unwrap_err().kind,
        webhooks.delete(id).await.unwrap_err().kind,
        webhooks.deliveries(id, None, None, None).await.unwrap_err().kind,
        webhooks.redeliver(id, Uuid::now_v7()).await.unwrap_err().kind,
    ];
    assert_eq!(kinds, [ErrorKind::NotFound; 5]);
}
