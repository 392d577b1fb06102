use std::time::Duration;

use uuid::Uuid;

use super::Fixture;
use crate::{Idempotency, IdempotencyOutcome, IdempotencySettings};
use whereabouts_core::Digest;
use whereabouts_store::StoredResponse;

fn response() -> StoredResponse {
    StoredResponse { status: 200, content_type: None, body: "answer".into() }
}

#[tokio::test]
async fn a_request_is_processed_once_and_its_response_replayed() {
    let fixture = Fixture::new().await;
    let requests = &fixture.service.idempotency;
    let (body, other) = (Digest::of(b"body"), Digest::of(b"other"));
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::InProgress);
    assert_eq!(requests.begin("key", other).await.unwrap(), IdempotencyOutcome::KeyReused);
    requests.end("key", body, Some(response())).await.unwrap();
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::Replay(response()));
    assert_eq!(requests.begin("key", other).await.unwrap(), IdempotencyOutcome::KeyReused);
    assert_eq!(requests.begin("another key", body).await.unwrap(), IdempotencyOutcome::First);
}

#[tokio::test]
async fn a_request_that_failed_is_processed_when_it_is_sent_again() {
    let fixture = Fixture::new().await;
    let requests = &fixture.service.idempotency;
    let body = Digest::of(b"body");
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
    requests.end("key", body, None).await.unwrap();
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
}

#[tokio::test]
async fn a_request_of_a_process_that_died_is_taken_over() {
    let fixture = Fixture::new().await;
    let Idempotency { store, settings, .. } = &fixture.service.idempotency;
    let dead = Idempotency { store: store.clone(), process: Uuid::now_v7(), settings: *settings };
    let body = Digest::of(b"body");
    assert_eq!(dead.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
    let requests = &fixture.service.idempotency;
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::InProgress);
}

#[tokio::test]
async fn an_expired_response_is_not_replayed() {
    let fixture = Fixture::new().await;
    let requests = &fixture.service.idempotency;
    let body = Digest::of(b"body");
    requests.begin("key", body).await.unwrap();
    requests.end("key", body, Some(response())).await.unwrap();
    let settings = IdempotencySettings { keep: Duration::ZERO, ..requests.settings };
    let expiring =
        Idempotency { store: requests.store.clone(), process: requests.process, settings };
    assert_eq!(expiring.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
}
