//! First answers to requests that may be sent again.

use std::sync::Arc;

use futures_util::future::join_all;
use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;
use whereabouts_core::Digest;
use whereabouts_store::{IdempotencyRecord, Progress, Store, StoredResponse};

use crate::support::{Fixture, eventually, odd_texts};

contract!(
    a_request_is_reserved_once_and_its_answer_kept,
    of_many_who_reserve_a_request_one_does_it,
    an_answer_that_is_too_old_is_none,
    a_forgotten_request_may_be_done_again,
    the_oldest_answers_are_forgotten_by_age_and_by_number,
    a_request_of_a_process_that_ended_may_be_done_again,
);

fn running(process: Uuid) -> IdempotencyRecord {
    let progress = Progress::Running { process, job: None };
    IdempotencyRecord { fingerprint: Digest::of(b"request"), at: Timestamp::now(), progress }
}

fn answered(at: Timestamp, body: &str) -> IdempotencyRecord {
    let (status, content_type) = (201, Some("application/json".into()));
    let progress = Progress::Answered(StoredResponse { status, content_type, body: body.into() });
    IdempotencyRecord { fingerprint: Digest::of(b"request"), at, progress }
}

/// What is known of a request, whatever its age; if that is nothing, it is reserved.
async fn reserve(store: &dyn Store, id: &str, process: Uuid) -> Option<IdempotencyRecord> {
    store.reserve_request(id, running(process), Timestamp::UNIX_EPOCH).await.unwrap()
}

async fn a_request_is_reserved_once_and_its_answer_kept(fixture: &Fixture) {
    let store = fixture.open().await;
    let process = Uuid::now_v7();
    for (number, text) in odd_texts().into_iter().enumerate() {
        let id = format!("key \"{number}\" 東京");
        let reserved = running(process);
        let first = store.reserve_request(&id, reserved.clone(), Timestamp::UNIX_EPOCH).await;
        assert_eq!(first.unwrap(), None);
        assert_eq!(reserve(&*store, &id, process).await, Some(reserved));
        let answer = answered(Timestamp::now(), &text);
        store.store_response(&id, answer.clone()).await.unwrap();
        assert_eq!(reserve(&*store, &id, process).await, Some(answer.clone()));
        assert_eq!(reserve(&*store, &id, Uuid::now_v7()).await, Some(answer));
    }
}

async fn of_many_who_reserve_a_request_one_does_it(fixture: &Fixture) {
    let store = fixture.open().await;
    let process = Uuid::now_v7();
    let reserving = (0..8).map(|_| {
        let store = Arc::clone(&store);
        tokio::spawn(async move { reserve(&*store, "key", process).await })
    });
    let known = join_all(reserving).await.into_iter().map(Result::unwrap);
    assert_eq!(known.filter(Option::is_none).count(), 1);
}

async fn an_answer_that_is_too_old_is_none(fixture: &Fixture) {
    let store = fixture.open().await;
    let (now, process) = (Timestamp::now(), Uuid::now_v7());
    let hour = SignedDuration::from_hours(1);
    store.store_response("key", answered(now - hour, "old")).await.unwrap();
    let known = store.reserve_request("key", running(process), now - hour * 2).await.unwrap();
    assert!(known.is_some());
    let known = store.reserve_request("key", running(process), now - hour / 2).await.unwrap();
    assert_eq!(known, None);
    // What is being done is not too old.
    let known = store.reserve_request("key", running(process), now + hour).await.unwrap();
    assert!(matches!(known.unwrap().progress, Progress::Running { .. }));
}

async fn a_forgotten_request_may_be_done_again(fixture: &Fixture) {
    let store = fixture.open().await;
    let process = Uuid::now_v7();
    store.forget_request("key").await.unwrap();
    assert_eq!(reserve(&*store, "key", process).await, None);
    store.forget_request("key").await.unwrap();
    assert_eq!(reserve(&*store, "key", process).await, None);
    store.store_response("key", answered(Timestamp::now(), "")).await.unwrap();
    store.forget_request("key").await.unwrap();
    assert_eq!(reserve(&*store, "key", process).await, None);
}

async fn the_oldest_answers_are_forgotten_by_age_and_by_number(fixture: &Fixture) {
    let store = fixture.open().await;
    let (now, process) = (Timestamp::now(), Uuid::now_v7());
    let hours_ago = |hours| now - SignedDuration::from_hours(hours);
    for hours in [5, 1, 4, 2, 3] {
        let answer = answered(hours_ago(hours), "");
        store.store_response(&hours.to_string(), answer).await.unwrap();
    }
    assert_eq!(store.prune_responses(hours_ago(6), 5).await.unwrap(), 0);
    let before = hours_ago(4) - SignedDuration::from_mins(30);
    assert_eq!(store.prune_responses(before, 9).await.unwrap(), 1);
    assert_eq!(store.prune_responses(hours_ago(6), 2).await.unwrap(), 2);
    for (hours, kept) in [(1, true), (2, true), (3, false), (4, false), (5, false)] {
        let known = reserve(&*store, &hours.to_string(), process).await;
        assert_eq!(known.is_some(), kept, "{hours}");
    }
    // Both at once: one is too old, and one too many.
    store.store_response("old", answered(hours_ago(9), "")).await.unwrap();
    assert_eq!(store.prune_responses(hours_ago(8), 4).await.unwrap(), 2);
    assert_eq!(store.prune_responses(now + SignedDuration::from_hours(1), 9).await.unwrap(), 4);
}

async fn a_request_of_a_process_that_ended_may_be_done_again(fixture: &Fixture) {
    let store = fixture.open().await;
    let (first, second) = (Uuid::now_v7(), Uuid::now_v7());
    assert_eq!(reserve(&*store, "running", first).await, None);
    let answer = answered(Timestamp::now(), "done");
    store.store_response("answered", answer.clone()).await.unwrap();
    drop(store);
    let store = fixture.open().await;
    let free = async || reserve(&*store, "running", second).await.is_none().then_some(());
    eventually(free).await;
    assert_eq!(reserve(&*store, "answered", second).await, Some(answer));
}
