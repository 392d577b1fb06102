//! Retention: ended jobs are removed with their frames, and usage by day.

use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;
use whereabouts_core::{Digest, Job, JobState};
use whereabouts_store::{JobFilter, JobRetention, RemovedJobs, Store};

use crate::support::{Fixture, claim, submit};

contract!(
    old_jobs_are_removed_with_frames_that_nothing_else_needs,
    excess_jobs_are_removed_oldest_end_first_in_batches,
    a_retried_job_is_kept_until_it_ends_again,
    jobs_are_removed_by_age_before_they_are_removed_by_number,
    nothing_is_removed_without_a_bound,
    the_size_of_the_database_is_known,
);

/// A job with a frame of its own, which failed this many days ago, or is queued.
async fn job(store: &dyn Store, frame: &str, days_ago: Option<i64>) -> Uuid {
    let id = submit(store, "m", frame.as_bytes()).await;
    if let Some(days) = days_ago {
        let claimed = claim(store).await.unwrap();
        assert_eq!(claimed.job.id, id);
        let at = Timestamp::now() - SignedDuration::from_hours(24 * days);
        let job = Job { state: JobState::Failed, finished_at: Some(at), ..claimed.job.clone() };
        store.finish(claimed.claim(), job).await.unwrap();
    }
    id
}

fn keep(days: i64, most: usize) -> JobRetention {
    let now = Timestamp::now();
    let since = now - SignedDuration::from_hours(24 * days);
    JobRetention { since: Some(since), most: Some(most), settled: now }
}

async fn has(store: &dyn Store, frame: &str) -> bool {
    store.blob(&Digest::of(frame.as_bytes())).await.unwrap().is_some()
}

async fn listed(store: &dyn Store, before: Option<Uuid>) -> Vec<Uuid> {
    let jobs = store.jobs(&JobFilter::default(), before, 10).await.unwrap().jobs;
    jobs.iter().map(|job| job.id).collect()
}

async fn old_jobs_are_removed_with_frames_that_nothing_else_needs(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    let old = job(store, "old", Some(40)).await;
    let shared = job(store, "shared", Some(40)).await;
    let young = job(store, "shared", Some(3)).await;
    let waiting = job(store, "waiting", None).await;
    let removed = store.remove_ended(keep(30, 100), 64).await.unwrap();
    assert_eq!(removed, RemovedJobs { by_age: 2, by_count: 0, bytes: 3 });
    assert!(!has(store, "old").await);
    assert!(has(store, "shared").await && has(store, "waiting").await);
    // A cursor may refer to a removed job.
    assert_eq!(listed(store, None).await, [waiting, young]);
    assert!(listed(store, Some(shared)).await.is_empty());
    assert_eq!(listed(store, Some(waiting)).await, [young]);
    assert!(store.job(old).await.unwrap().is_none());
    assert!(store.retry(old, None).await.is_err());
    let again = store.remove_ended(keep(30, 100), 64).await.unwrap();
    assert_eq!(again, RemovedJobs::default());
}

async fn excess_jobs_are_removed_oldest_end_first_in_batches(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    let mut jobs = Vec::new();
    for (frame, days) in [("a", 1), ("b", 5), ("c", 2), ("d", 4)] {
        jobs.push(job(store, frame, Some(days)).await);
    }
    let batch = store.remove_ended(keep(30, 1), 2).await.unwrap();
    assert_eq!((batch.by_count, batch.by_age), (2, 0));
    assert_eq!(listed(store, None).await, [jobs[2], jobs[0]]);
    assert_eq!(store.remove_ended(keep(30, 1), 2).await.unwrap().by_count, 1);
    assert_eq!(listed(store, None).await, [jobs[0]]);
    // A client that long-polls may not have seen its end yet.
    let unsettled = JobRetention { settled: Timestamp::UNIX_EPOCH, ..keep(0, 0) };
    assert_eq!(store.remove_ended(unsettled, 2).await.unwrap().jobs(), 0);
}

async fn a_retried_job_is_kept_until_it_ends_again(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    let id = job(store, "a", Some(40)).await;
    store.retry(id, None).await.unwrap();
    assert_eq!(store.remove_ended(keep(30, 0), 8).await.unwrap().jobs(), 0);
    store.cancel(id).await.unwrap();
    let removed = store.remove_ended(keep(30, 0), 8).await.unwrap();
    assert_eq!((removed.by_count, removed.bytes), (1, 1));
}

async fn jobs_are_removed_by_age_before_they_are_removed_by_number(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    for days in [50, 40, 3, 2, 1] {
        job(store, "frame", Some(days)).await;
    }
    let removed = store.remove_ended(keep(30, 2), 64).await.unwrap();
    assert_eq!((removed.by_age, removed.by_count), (2, 1));
    assert_eq!(listed(store, None).await.len(), 2);
    let by_age = JobRetention { most: None, ..keep(2, 0) };
    let removed = store.remove_ended(by_age, 64).await.unwrap();
    assert_eq!((removed.by_age, removed.by_count), (1, 0));
    let by_number = JobRetention { since: None, ..keep(0, 0) };
    let removed = store.remove_ended(by_number, 64).await.unwrap();
    assert_eq!((removed.by_age, removed.by_count, removed.bytes), (0, 1, 5));
}

async fn nothing_is_removed_without_a_bound(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = job(&*store, "a", Some(4000)).await;
    let all = JobRetention { since: None, most: None, settled: Timestamp::now() };
    assert_eq!(store.remove_ended(all, 64).await.unwrap(), RemovedJobs::default());
    assert_eq!(listed(&*store, None).await, [id]);
}

async fn the_size_of_the_database_is_known(fixture: &Fixture) {
    let store = fixture.open().await;
    assert!(store.db_bytes().await.unwrap() > 0);
    assert!(store.free_bytes().await.is_none_or(|free| free > 0));
}
