//! Jobs: claims, leases, releases, retries and cancellation.

use std::collections::HashSet;
use std::sync::Arc;

use futures_util::future::join_all;
use jiff::{SignedDuration, Timestamp};
use tokio::sync::broadcast;
use uuid::Uuid;
use whereabouts_core::{Candidate, Description, Job, JobState, Priority, StandIn, Usage};
use whereabouts_store::{Claim, JobFilter, JobRecord, Release, Step, Store, StoreError};

use crate::support::{
    Fixture, claim, descriptor, eventually, image, odd_texts, record, submit, submit_record, until,
};

contract!(
    a_job_is_returned_as_submitted,
    jobs_are_claimed_by_priority_and_then_by_age,
    a_job_is_claimed_by_one_worker_at_a_time,
    a_job_with_an_expired_lease_is_claimed_again_and_the_first_worker_is_fenced_off,
    a_released_job_waits_until_it_is_due,
    a_deferred_release_does_not_count_as_an_attempt,
    steps_add_up_and_a_description_replaces_that_of_the_same_image,
    a_cancelled_job_is_held_by_no_worker,
    an_unsuccessful_job_may_be_queued_again,
    the_queue_limit_is_exact,
    every_change_of_a_job_is_notified,
    an_unknown_job_is_not_found,
    a_job_survives_a_restart_and_is_released_by_the_worker_that_died,
    odd_texts_in_a_job_survive,
);

fn ended(record: &JobRecord, state: JobState) -> Job {
    Job { state, finished_at: Some(Timestamp::now()), ..record.job.clone() }
}

fn release(why: &str) -> Release {
    Release { why: why.into(), not_before: None, counts: true }
}

async fn job(store: &dyn Store, id: Uuid) -> Job {
    store.job(id).await.unwrap().unwrap().job
}

async fn a_job_is_returned_as_submitted(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut given = record("m", b"frame");
    let frame = image("frame", b"frame");
    given.map_uid = Uuid::now_v7();
    given.revision = 7;
    given.query.descriptor = Some(descriptor(&frame, 100));
    given.candidates = (1..=3)
        .map(|rank| Candidate {
            rank,
            image_id: format!("東京-{rank}").parse().unwrap(),
            similarity: 1.0 / rank as f32,
            pose: None,
            order: None,
        })
        .collect();
    submit_record(&*store, given.clone(), b"frame").await;
    let same = |found: &JobRecord| {
        assert_eq!(serde_json::to_value(found).unwrap(), serde_json::to_value(&given).unwrap());
    };
    same(&store.job(given.job.id).await.unwrap().unwrap());
    let taken = claim(&*store).await.unwrap();
    assert_eq!((taken.claims, taken.job.attempts, taken.job.state), (1, 1, JobState::Running));
    assert!(taken.job.started_at.is_some());
    same(&JobRecord { job: given.job.clone(), claims: 0, ..taken });
}

async fn jobs_are_claimed_by_priority_and_then_by_age(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut jobs = Vec::new();
    for priority in [
        Priority::Low,
        Priority::Normal,
        Priority::High,
        Priority::Low,
        Priority::High,
        Priority::Normal,
    ] {
        let mut record = record("m", b"frame");
        record.job.priority = priority;
        jobs.push(record.job.id);
        submit_record(&*store, record, b"frame").await;
    }
    assert_eq!(store.queued().await.unwrap(), 6);
    let made_at = |id: Uuid| {
        let (seconds, nanoseconds) = id.get_timestamp().unwrap().to_unix();
        Timestamp::new(seconds as i64, nanoseconds as i32).unwrap()
    };
    // The open jobs after each step, oldest first.
    let left = [&[0, 1, 3, 4, 5][..], &[0, 1, 3, 5], &[0, 3, 5], &[0, 3], &[3], &[]];
    for (expected, left) in [2, 4, 1, 5, 0, 3].into_iter().zip(left) {
        let taken = claim(&*store).await.unwrap();
        assert_eq!(taken.job.id, jobs[expected]);
        store.finish(taken.claim(), ended(&taken, JobState::Succeeded)).await.unwrap();
        let oldest = left.first().map(|oldest| made_at(jobs[*oldest]));
        assert_eq!(store.oldest_unfinished().await.unwrap(), oldest);
    }
    assert!(claim(&*store).await.is_none());
    assert_eq!(store.queued().await.unwrap(), 0);
}

async fn a_job_is_claimed_by_one_worker_at_a_time(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut submitted = HashSet::new();
    for _ in 0..30 {
        submitted.insert(submit(&*store, "m", b"frame").await);
    }
    let workers = (0..6).map(|_| {
        let store = Arc::clone(&store);
        tokio::spawn(async move {
            let mut taken = Vec::new();
            while let Some(record) = claim(&*store).await {
                taken.push(record.job.id);
            }
            taken
        })
    });
    let taken: Vec<Uuid> = join_all(workers).await.into_iter().flat_map(Result::unwrap).collect();
    assert_eq!(taken.len(), 30);
    assert_eq!(taken.into_iter().collect::<HashSet<_>>(), submitted);
}

const BRIEF_LEASE: SignedDuration = SignedDuration::from_millis(50);

/// Claims a job with a lease of a moment.
async fn claim_briefly(store: &dyn Store) -> JobRecord {
    let now = Timestamp::now();
    store.claim(now, now + BRIEF_LEASE).await.unwrap().unwrap()
}

/// Asserts that the claim can no longer change the job.
async fn is_void(store: &dyn Store, old: &JobRecord, claim: Claim) {
    let before = serde_json::to_value(store.job(claim.job).await.unwrap().unwrap()).unwrap();
    let usage = Usage { calls: 99, ..Usage::default() };
    store.progress(claim, Step { usage, description: None }).await.unwrap();
    store.release(claim, release("late")).await.unwrap();
    store.finish(claim, ended(old, JobState::Succeeded)).await.unwrap();
    let after = serde_json::to_value(store.job(claim.job).await.unwrap().unwrap()).unwrap();
    assert_eq!(before, after);
}

async fn a_job_with_an_expired_lease_is_claimed_again_and_the_first_worker_is_fenced_off(
    fixture: &Fixture,
) {
    let store = fixture.open().await;
    let id = submit(&*store, "m", b"frame").await;
    let first = claim_briefly(&*store).await;
    let second = eventually(async || claim(&*store).await).await;
    assert_eq!((second.job.id, second.claims, second.job.attempts), (id, 2, 2));
    assert_eq!(second.job.started_at, first.job.started_at);
    assert!(second.is_held_by(second.claim()) && !second.is_held_by(first.claim()));
    is_void(&*store, &first, first.claim()).await;
    assert!(claim(&*store).await.is_none());
    store.finish(second.claim(), ended(&second, JobState::Failed)).await.unwrap();
    assert_eq!(job(&*store, id).await.state, JobState::Failed);
    is_void(&*store, &second, second.claim()).await;
    // As long as no other worker has claimed it, a worker may finish it late.
    let id = submit(&*store, "m", b"frame").await;
    let late = claim_briefly(&*store).await;
    let lease_ends = Timestamp::now() + BRIEF_LEASE;
    until(async || Timestamp::now() > lease_ends).await;
    store.finish(late.claim(), ended(&late, JobState::Succeeded)).await.unwrap();
    assert_eq!(job(&*store, id).await.state, JobState::Succeeded);
    assert!(claim(&*store).await.is_none());
}

async fn a_released_job_waits_until_it_is_due(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = submit(&*store, "m", b"frame").await;
    let first = claim(&*store).await.unwrap();
    store.release(first.claim(), release("at once")).await.unwrap();
    let waiting = job(&*store, id).await;
    assert_eq!((waiting.state, waiting.error.as_deref()), (JobState::Queued, Some("at once")));
    is_void(&*store, &first, first.claim()).await;
    let second = claim(&*store).await.unwrap();
    assert_eq!((second.job.attempts, second.job.error.as_deref()), (2, None));
    let not_before = Timestamp::now() + SignedDuration::from_millis(200);
    let later = Release { not_before: Some(not_before), ..release("later") };
    store.release(second.claim(), later).await.unwrap();
    assert!(claim(&*store).await.is_none());
    assert_eq!(store.queued().await.unwrap(), 1);
    // Other jobs overtake it.
    let other = submit(&*store, "m", b"frame").await;
    assert_eq!(claim(&*store).await.unwrap().job.id, other);
    assert_eq!(eventually(async || claim(&*store).await).await.job.id, id);
    assert!(Timestamp::now() >= not_before);
}

async fn a_deferred_release_does_not_count_as_an_attempt(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = submit(&*store, "m", b"frame").await;
    for _ in 0..3 {
        let taken = claim(&*store).await.unwrap();
        assert_eq!(taken.job.attempts, 1);
        let uncounted = Release { counts: false, ..release("not its fault") };
        store.release(taken.claim(), uncounted).await.unwrap();
        assert_eq!(job(&*store, id).await.attempts, 0);
    }
    assert_eq!(claim(&*store).await.unwrap().claims, 4);
}

async fn steps_add_up_and_a_description_replaces_that_of_the_same_image(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut given = record("m", b"frame");
    let ids = ["b", "a"];
    given.candidates = ids
        .iter()
        .zip(1..)
        .map(|(id, rank)| Candidate {
            rank,
            image_id: id.parse().unwrap(),
            similarity: 0.5,
            pose: None,
            order: None,
        })
        .collect();
    let id = given.job.id;
    submit_record(&*store, given, b"frame").await;
    let taken = claim(&*store).await.unwrap();
    let usage =
        Usage { calls: 1, cached: 2, prompt_tokens: 1 << 40, completion_tokens: 3, estimated: 1 };
    let stands_in = Some(StandIn { query_id: Uuid::now_v7(), similarity: 0.99 });
    for (image_id, text) in [("a", "first"), ("b", "second"), ("a", "third")] {
        let (image_id, text) = (image_id.parse().unwrap(), text.to_owned());
        let description =
            Some(Description { image_id, text, cached: true, stands_in, took_ms: None, usage });
        store.progress(taken.claim(), Step { usage, description }).await.unwrap();
    }
    store.progress(taken.claim(), Step { usage, description: None }).await.unwrap();
    let known = job(&*store, id).await;
    assert_eq!((known.usage.calls, known.usage.prompt_tokens), (4, 4 << 40));
    // In the order of the candidates.
    let texts: Vec<_> =
        known.descriptions.iter().map(|d| (d.image_id.as_str(), d.text.as_str())).collect();
    assert_eq!(texts, [("b", "second"), ("a", "third")]);
    assert_eq!(known.descriptions[0].stands_in, stands_in);
}

async fn a_cancelled_job_is_held_by_no_worker(fixture: &Fixture) {
    let store = fixture.open().await;
    let waiting = submit(&*store, "m", b"frame").await;
    let cancelled = store.cancel(waiting).await.unwrap();
    assert_eq!(cancelled.state, JobState::Cancelled);
    assert!(cancelled.finished_at.is_some());
    assert!(claim(&*store).await.is_none());
    let running = submit(&*store, "m", b"frame").await;
    let taken = claim(&*store).await.unwrap();
    store.cancel(running).await.unwrap();
    is_void(&*store, &taken, taken.claim()).await;
    assert_eq!(store.queued().await.unwrap(), 0);
    // An ended job does not change.
    assert_eq!(store.cancel(waiting).await.unwrap(), cancelled);
}

async fn an_unsuccessful_job_may_be_queued_again(fixture: &Fixture) {
    let store = fixture.open().await;
    for state in [JobState::Failed, JobState::Degraded, JobState::Cancelled] {
        let id = submit(&*store, "m", b"frame").await;
        let refused = store.retry(id, None).await.unwrap_err();
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
        let taken = claim(&*store).await.unwrap();
        let usage = Usage { calls: 1, ..Usage::default() };
        store.progress(taken.claim(), Step { usage, description: None }).await.unwrap();
        assert!(store.retry(id, None).await.is_err());
        let end = Job { error: Some("why".into()), ..ended(&taken, state) };
        store.finish(taken.claim(), end).await.unwrap();
        assert_eq!(store.queued().await.unwrap(), 0);
        let again = store.retry(id, None).await.unwrap();
        assert_eq!((again.state, again.attempts), (JobState::Queued, 0));
        assert_eq!((again.usage, again.finished_at, again.error), (Usage::default(), None, None));
        assert_eq!(store.queued().await.unwrap(), 1);
        is_void(&*store, &taken, taken.claim()).await;
        let second = claim(&*store).await.unwrap();
        assert_eq!((second.job.id, second.job.attempts, second.claims), (id, 1, 2));
        is_void(&*store, &taken, taken.claim()).await;
        store.finish(second.claim(), ended(&second, JobState::Succeeded)).await.unwrap();
        let refused = store.retry(id, None).await.unwrap_err();
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    }
}

async fn the_queue_limit_is_exact(fixture: &Fixture) {
    let store = fixture.open().await;
    const LIMIT: usize = 10;
    // A running job counts, too.
    submit(&*store, "m", b"frame").await;
    let running = claim(&*store).await.unwrap();
    let submitting = (0..30).map(|_| {
        let store = Arc::clone(&store);
        tokio::spawn(async move { store.submit(record("m", b"frame"), LIMIT).await })
    });
    let submitted = join_all(submitting).await.into_iter().map(Result::unwrap);
    let (mut accepted, mut refused) = (0, 0);
    for submitted in submitted {
        match submitted {
            Ok(()) => accepted += 1,
            Err(StoreError::QueueFull { limit: LIMIT }) => refused += 1,
            Err(error) => panic!("{error}"),
        }
    }
    assert_eq!((accepted, refused), (LIMIT - 1, 30 - LIMIT + 1));
    assert_eq!(store.queued().await.unwrap(), LIMIT);
    store.finish(running.claim(), ended(&running, JobState::Failed)).await.unwrap();
    store.submit(record("m", b"frame"), LIMIT).await.unwrap();
    // A job that is queued again is not rejected.
    store.retry(running.job.id, None).await.unwrap();
    assert_eq!(store.queued().await.unwrap(), LIMIT + 1);
    assert!(store.submit(record("m", b"frame"), LIMIT).await.is_err());
}

/// Waits for the next notification about a job.
async fn notified(changes: &mut broadcast::Receiver<Uuid>, of: Uuid) {
    let timeout = std::time::Duration::from_secs(20);
    tokio::time::timeout(timeout, async { while changes.recv().await.unwrap() != of {} })
        .await
        .unwrap();
}

async fn every_change_of_a_job_is_notified(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut changes = store.changes();
    let id = submit(&*store, "m", b"frame").await;
    notified(&mut changes, id).await;
    let taken = claim(&*store).await.unwrap();
    notified(&mut changes, id).await;
    let step = Step { usage: Usage::default(), description: None };
    store.progress(taken.claim(), step).await.unwrap();
    notified(&mut changes, id).await;
    store.release(taken.claim(), release("why")).await.unwrap();
    notified(&mut changes, id).await;
    let taken = claim(&*store).await.unwrap();
    notified(&mut changes, id).await;
    store.finish(taken.claim(), ended(&taken, JobState::Failed)).await.unwrap();
    notified(&mut changes, id).await;
    store.retry(id, None).await.unwrap();
    notified(&mut changes, id).await;
    store.cancel(id).await.unwrap();
    notified(&mut changes, id).await;
}

async fn an_unknown_job_is_not_found(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = submit(&*store, "m", b"frame").await;
    let taken = claim(&*store).await.unwrap();
    let gone = Uuid::now_v7();
    assert!(store.job(gone).await.unwrap().is_none());
    for refused in [store.cancel(gone).await, store.retry(gone, None).await] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, StoreError::NotFound(_)), "{refused}");
    }
    assert_eq!(taken.job.id, id);
}

async fn a_job_survives_a_restart_and_is_released_by_the_worker_that_died(fixture: &Fixture) {
    let store = fixture.open().await;
    let running = submit(&*store, "m", b"frame").await;
    let waiting = submit(&*store, "m", b"frame").await;
    let done = submit(&*store, "m", b"frame").await;
    store.cancel(done).await.unwrap();
    let taken = claim(&*store).await.unwrap();
    assert_eq!(taken.job.id, running);
    drop(store);
    let store = fixture.open().await;
    assert_eq!(store.queued().await.unwrap(), 2);
    assert_eq!(job(&*store, done).await.state, JobState::Cancelled);
    let mut again = HashSet::new();
    while again.len() < 2 {
        again.insert(eventually(async || claim(&*store).await).await.job.id);
    }
    assert_eq!(again, HashSet::from([running, waiting]));
    is_void(&*store, &taken, taken.claim()).await;
}

async fn odd_texts_in_a_job_survive(fixture: &Fixture) {
    let store = fixture.open().await;
    for text in odd_texts() {
        let id = submit(&*store, "m", b"frame").await;
        let taken = claim(&*store).await.unwrap();
        let description = Description {
            image_id: "a".parse().unwrap(),
            text: text.clone(),
            cached: false,
            stands_in: None,
            took_ms: None,
            usage: Usage::default(),
        };
        let step = Step { usage: Usage::default(), description: Some(description) };
        store.progress(taken.claim(), step).await.unwrap();
        store.release(taken.claim(), release(&text)).await.unwrap();
        assert_eq!(job(&*store, id).await.error.as_ref(), Some(&text));
        let taken = claim(&*store).await.unwrap();
        assert_eq!(taken.job.descriptions[0].text, text);
        let job = Job {
            error: Some(text.clone()),
            reasoning: Some(text.clone()),
            ..ended(&taken, JobState::Degraded)
        };
        store.finish(taken.claim(), job.clone()).await.unwrap();
        assert_eq!(store.job(id).await.unwrap().unwrap().job, job);
        assert_eq!(store.jobs(&JobFilter::default(), None, 1).await.unwrap().jobs, [job]);
    }
}
