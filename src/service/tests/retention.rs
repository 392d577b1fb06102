use std::time::Duration;

use jiff::Timestamp;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::Fixture;
use crate::{IdempotencyOutcome, IdempotencySettings, Janitor};
use whereabouts_core::Digest;
use whereabouts_refine::JobSettings;
use whereabouts_store::{JobFilter, StoredResponse};

/// A janitor that removes whatever has ended, one job at a time.
fn janitor(fixture: &Fixture) -> Janitor {
    Janitor {
        store: fixture.store.clone(),
        answers: fixture.store.clone(),
        metrics: fixture.service.metrics.clone(),
        jobs: JobSettings {
            keep: Some(Duration::ZERO),
            max_wait: Duration::ZERO,
            ..super::job_settings()
        },
        usage_days: 1,
        idempotency: IdempotencySettings { keep: Duration::from_secs(3600), most: 100 },
    }
}

/// Three jobs that have ended, oldest first, and one that waits.
async fn jobs(fixture: &Fixture) -> [Uuid; 4] {
    let mut ids = [Uuid::nil(); 4];
    for id in &mut ids {
        *id = fixture.job("yard").await.id;
    }
    for id in &ids[..3] {
        fixture.service.jobs.cancel(*id).await.unwrap();
    }
    ids
}

async fn left(fixture: &Fixture) -> Vec<Uuid> {
    let page = fixture.service.jobs.list(JobFilter::default(), None, None).await.unwrap();
    page.jobs.iter().rev().map(|job| job.id).collect()
}

#[tokio::test]
async fn jobs_are_removed_with_their_frames_when_they_ended_too_long_ago() {
    let fixture = Fixture::new().await;
    let ids = jobs(&fixture).await;
    let mut janitor = janitor(&fixture);
    janitor.jobs.keep = Some(Duration::from_secs(3600));
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(left(&fixture).await, ids);
    janitor.jobs.keep = Some(Duration::ZERO);
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(left(&fixture).await, ids[3..]);
    let blobs = &fixture.service.jobs.blobs;
    for (id, kept) in [(ids[0], false), (ids[3], true)] {
        let frame = blobs.blob(&Digest::of(id.as_bytes())).await.unwrap();
        assert_eq!(frame.is_some(), kept);
    }
}

#[tokio::test]
async fn the_first_jobs_to_end_are_removed_when_there_are_too_many() {
    let fixture = Fixture::new().await;
    let ids = jobs(&fixture).await;
    let mut janitor = janitor(&fixture);
    janitor.jobs.keep = None;
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(left(&fixture).await, ids, "there is no bound");
    janitor.jobs.keep_count = Some(1);
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(left(&fixture).await, ids[2..]);
}

#[tokio::test]
async fn a_job_that_has_just_ended_stays_until_its_waiters_have_seen_it() {
    let fixture = Fixture::new().await;
    let ids = jobs(&fixture).await;
    let mut janitor = janitor(&fixture);
    janitor.jobs.keep_count = Some(0);
    janitor.jobs.max_wait = Duration::from_secs(60);
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(left(&fixture).await, ids);
}

#[tokio::test]
async fn a_sweep_stops_between_two_batches_at_shutdown() {
    let fixture = Fixture::new().await;
    let ids = jobs(&fixture).await;
    let shutdown = CancellationToken::new();
    shutdown.cancel();
    janitor(&fixture).sweep(&shutdown).await.unwrap();
    assert_eq!(left(&fixture).await, ids);
}

#[tokio::test]
async fn expired_responses_are_removed() {
    let fixture = Fixture::new().await;
    let requests = &fixture.service.idempotency;
    let body = Digest::of(b"body");
    let response = StoredResponse { status: 200, content_type: None, body: String::new() };
    requests.begin("key", body).await.unwrap();
    requests.end("key", body, Some(response.clone())).await.unwrap();
    let mut janitor = janitor(&fixture);
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::Replay(response));
    janitor.idempotency.keep = Duration::ZERO;
    // The store counts ages in whole milliseconds.
    let answered = Timestamp::now().as_millisecond();
    while Timestamp::now().as_millisecond() == answered {
        tokio::task::yield_now().await;
    }
    janitor.sweep(&CancellationToken::new()).await.unwrap();
    assert_eq!(requests.begin("key", body).await.unwrap(), IdempotencyOutcome::First);
}
