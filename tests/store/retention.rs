//! Forgetting: jobs that have ended go with their frames, accounts by their day.

use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;
use whereabouts_core::{Digest, Job, JobState};
use whereabouts_store::{JobFilter, JobRetention, RemovedJobs, Store};

use crate::support::{Fixture, claim, submit};

contract!(
    old_jobs_go_with_frames_that_nothing_else_needs,
    the_first_to_end_go_while_there_are_too_many_a_batch_at_a_time,
    a_job_that_is_retried_is_kept_until_it_has_ended_again,
    jobs_go_by_their_age_before_they_go_by_their_number,
    nothing_goes_where_nothing_is_bounded,
    the_size_of_the_database_is_known,
);

/// A job with a frame of its own, which failed so many days ago unless it waits.
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

async fn old_jobs_go_with_frames_that_nothing_else_needs(fixture: &Fixture) {
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
    // A cursor may stand on a job that has gone.
    assert_eq!(listed(store, None).await, [waiting, young]);
    assert!(listed(store, Some(shared)).await.is_empty());
    assert_eq!(listed(store, Some(waiting)).await, [young]);
    assert!(store.job(old).await.unwrap().is_none());
    assert!(store.retry(old).await.is_err());
    let again = store.remove_ended(keep(30, 100), 64).await.unwrap();
    assert_eq!(again, RemovedJobs::default());
}

async fn the_first_to_end_go_while_there_are_too_many_a_batch_at_a_time(fixture: &Fixture) {
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
    // Whoever waits for it has not seen its end yet.
    let unsettled = JobRetention { settled: Timestamp::UNIX_EPOCH, ..keep(0, 0) };
    assert_eq!(store.remove_ended(unsettled, 2).await.unwrap().jobs(), 0);
}

async fn a_job_that_is_retried_is_kept_until_it_has_ended_again(fixture: &Fixture) {
    let store = fixture.open().await;
    let store = &*store;
    let id = job(store, "a", Some(40)).await;
    store.retry(id).await.unwrap();
    assert_eq!(store.remove_ended(keep(30, 0), 8).await.unwrap().jobs(), 0);
    store.cancel(id).await.unwrap();
    let removed = store.remove_ended(keep(30, 0), 8).await.unwrap();
    assert_eq!((removed.by_count, removed.bytes), (1, 1));
}

async fn jobs_go_by_their_age_before_they_go_by_their_number(fixture: &Fixture) {
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

async fn nothing_goes_where_nothing_is_bounded(fixture: &Fixture) {
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
