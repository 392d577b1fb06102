//! Jobs: who takes which, for how long, and what becomes of them.

use std::collections::HashSet;
use std::sync::Arc;

use futures_util::future::join_all;
use jiff::{SignedDuration, Timestamp};
use tokio::sync::broadcast;
use uuid::Uuid;
use whereabouts_core::{Candidate, Description, Digest, Job, JobState, Priority, StandIn, Usage};
use whereabouts_store::{
    Claim, IdempotencyRecord, JobFilter, JobRecord, Progress, Release, Step, Store, StoreError,
};

use crate::support::{
    Fixture, claim, descriptor, eventually, image, odd_texts, record, submit, submit_record,
};

contract!(
    a_job_comes_back_as_it_was_given,
    jobs_are_taken_by_priority_and_then_by_age,
    a_job_is_taken_by_one_worker_at_a_time,
    a_job_whose_lease_ran_out_is_taken_again_and_nobody_hears_the_first_worker,
    a_released_job_waits_for_its_time,
    a_release_that_does_not_count_takes_the_attempt_back,
    steps_add_up_and_a_description_replaces_that_of_the_same_image,
    a_cancelled_job_is_nobodys,
    a_job_that_ended_without_success_may_be_queued_again,
    the_queue_holds_exactly_so_many,
    every_change_is_told,
    jobs_are_listed_newest_first_by_map_and_state_a_page_at_a_time,
    jobs_are_searched_for_a_text,
    a_request_that_is_done_again_finds_its_job,
    a_job_that_is_not_there_is_not_found,
    a_job_outlives_a_restart_and_is_free_of_the_worker_that_did_not,
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

async fn a_job_comes_back_as_it_was_given(fixture: &Fixture) {
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

async fn jobs_are_taken_by_priority_and_then_by_age(fixture: &Fixture) {
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
    // What is left then, the oldest first.
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

async fn a_job_is_taken_by_one_worker_at_a_time(fixture: &Fixture) {
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

/// Takes a job for a moment.
async fn claim_briefly(store: &dyn Store) -> JobRecord {
    let now = Timestamp::now();
    let lease = SignedDuration::from_millis(50);
    store.claim(now, now + lease).await.unwrap().unwrap()
}

/// Nothing that is done with the claim changes the job.
async fn is_void(store: &dyn Store, old: &JobRecord, claim: Claim) {
    let before = serde_json::to_value(store.job(claim.job).await.unwrap().unwrap()).unwrap();
    let usage = Usage { calls: 99, ..Usage::default() };
    store.progress(claim, Step { usage, description: None }).await.unwrap();
    store.release(claim, release("late")).await.unwrap();
    store.finish(claim, ended(old, JobState::Succeeded)).await.unwrap();
    let after = serde_json::to_value(store.job(claim.job).await.unwrap().unwrap()).unwrap();
    assert_eq!(before, after);
}

async fn a_job_whose_lease_ran_out_is_taken_again_and_nobody_hears_the_first_worker(
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
    // While nobody else has taken it, a worker may end it late.
    let id = submit(&*store, "m", b"frame").await;
    let late = claim_briefly(&*store).await;
    tokio::time::sleep(std::time::Duration::from_millis(60)).await;
    store.finish(late.claim(), ended(&late, JobState::Succeeded)).await.unwrap();
    assert_eq!(job(&*store, id).await.state, JobState::Succeeded);
    assert!(claim(&*store).await.is_none());
}

async fn a_released_job_waits_for_its_time(fixture: &Fixture) {
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
    // Others pass it.
    let other = submit(&*store, "m", b"frame").await;
    assert_eq!(claim(&*store).await.unwrap().job.id, other);
    assert_eq!(eventually(async || claim(&*store).await).await.job.id, id);
    assert!(Timestamp::now() >= not_before);
}

async fn a_release_that_does_not_count_takes_the_attempt_back(fixture: &Fixture) {
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

async fn a_cancelled_job_is_nobodys(fixture: &Fixture) {
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
    // One that has ended stays as it ended.
    assert_eq!(store.cancel(waiting).await.unwrap(), cancelled);
}

async fn a_job_that_ended_without_success_may_be_queued_again(fixture: &Fixture) {
    let store = fixture.open().await;
    for state in [JobState::Failed, JobState::Degraded, JobState::Cancelled] {
        let id = submit(&*store, "m", b"frame").await;
        let refused = store.retry(id).await.unwrap_err();
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
        let taken = claim(&*store).await.unwrap();
        let usage = Usage { calls: 1, ..Usage::default() };
        store.progress(taken.claim(), Step { usage, description: None }).await.unwrap();
        assert!(store.retry(id).await.is_err());
        let end = Job { error: Some("why".into()), ..ended(&taken, state) };
        store.finish(taken.claim(), end).await.unwrap();
        assert_eq!(store.queued().await.unwrap(), 0);
        let again = store.retry(id).await.unwrap();
        assert_eq!((again.state, again.attempts), (JobState::Queued, 0));
        assert_eq!((again.usage, again.finished_at, again.error), (Usage::default(), None, None));
        assert_eq!(store.queued().await.unwrap(), 1);
        is_void(&*store, &taken, taken.claim()).await;
        let second = claim(&*store).await.unwrap();
        assert_eq!((second.job.id, second.job.attempts, second.claims), (id, 1, 2));
        is_void(&*store, &taken, taken.claim()).await;
        store.finish(second.claim(), ended(&second, JobState::Succeeded)).await.unwrap();
        let refused = store.retry(id).await.unwrap_err();
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    }
}

async fn the_queue_holds_exactly_so_many(fixture: &Fixture) {
    let store = fixture.open().await;
    const LIMIT: usize = 10;
    // One runs, which counts as well.
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
    // One that is queued again is not refused.
    store.retry(running.job.id).await.unwrap();
    assert_eq!(store.queued().await.unwrap(), LIMIT + 1);
    assert!(store.submit(record("m", b"frame"), LIMIT).await.is_err());
}

/// The next change of a job that is told.
async fn told(changes: &mut broadcast::Receiver<Uuid>, of: Uuid) {
    let patience = std::time::Duration::from_secs(20);
    tokio::time::timeout(patience, async { while changes.recv().await.unwrap() != of {} })
        .await
        .unwrap();
}

async fn every_change_is_told(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut changes = store.changes();
    let id = submit(&*store, "m", b"frame").await;
    told(&mut changes, id).await;
    let taken = claim(&*store).await.unwrap();
    told(&mut changes, id).await;
    let step = Step { usage: Usage::default(), description: None };
    store.progress(taken.claim(), step).await.unwrap();
    told(&mut changes, id).await;
    store.release(taken.claim(), release("why")).await.unwrap();
    told(&mut changes, id).await;
    let taken = claim(&*store).await.unwrap();
    told(&mut changes, id).await;
    store.finish(taken.claim(), ended(&taken, JobState::Failed)).await.unwrap();
    told(&mut changes, id).await;
    store.retry(id).await.unwrap();
    told(&mut changes, id).await;
    store.cancel(id).await.unwrap();
    told(&mut changes, id).await;
}

async fn jobs_are_listed_newest_first_by_map_and_state_a_page_at_a_time(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut ids = Vec::new();
    for map in ["yard", "vault", "yard", "yard", "vault"] {
        ids.push(submit(&*store, map, b"frame").await);
    }
    for id in &ids[..2] {
        store.cancel(*id).await.unwrap();
    }
    let listed = async |map: Option<&str>, state, before, limit| -> Vec<usize> {
        let map = map.map(|map| map.parse().unwrap());
        let filter = JobFilter { map, state, text: None };
        let jobs = store.jobs(&filter, before, limit).await.unwrap().jobs;
        jobs.iter().map(|job| ids.iter().position(|id| *id == job.id).unwrap()).collect()
    };
    let (queued, cancelled) = (Some(JobState::Queued), Some(JobState::Cancelled));
    assert_eq!(listed(None, None, None, 9).await, [4, 3, 2, 1, 0]);
    assert_eq!(listed(None, None, None, 2).await, [4, 3]);
    assert_eq!(listed(None, None, Some(ids[3]), 2).await, [2, 1]);
    assert_eq!(listed(Some("yard"), None, None, 9).await, [3, 2, 0]);
    assert_eq!(listed(Some("yard"), queued, None, 9).await, [3, 2]);
    assert_eq!(listed(Some("yard"), queued, Some(ids[3]), 9).await, [2]);
    assert_eq!(listed(None, cancelled, None, 1).await, [1]);
    assert_eq!(listed(None, Some(JobState::Running), None, 9).await, [0; 0]);
    assert_eq!(listed(Some("elsewhere"), None, None, 9).await, [0; 0]);
    claim(&*store).await.unwrap();
    assert_eq!(listed(None, Some(JobState::Running), None, 9).await, [2]);
}

async fn a_job_that_is_not_there_is_not_found(fixture: &Fixture) {
    let store = fixture.open().await;
    let id = submit(&*store, "m", b"frame").await;
    let taken = claim(&*store).await.unwrap();
    let gone = Uuid::now_v7();
    assert!(store.job(gone).await.unwrap().is_none());
    for refused in [store.cancel(gone).await, store.retry(gone).await] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, StoreError::NotFound(_)), "{refused}");
    }
    assert_eq!(taken.job.id, id);
}

async fn a_job_outlives_a_restart_and_is_free_of_the_worker_that_did_not(fixture: &Fixture) {
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

async fn jobs_are_searched_for_a_text(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut ids = Vec::new();
    for map in ["town", "yard", "town"] {
        ids.push(submit(&*store, map, b"frame").await);
    }
    let search = async |text: &str, limit| -> Vec<Uuid> {
        let filter = JobFilter { text: Some(text.into()), ..JobFilter::default() };
        let list = store.jobs(&filter, None, limit).await.unwrap();
        assert_eq!(list.searched_to, None);
        list.jobs.iter().map(|job| job.id).collect()
    };
    assert_eq!(search("TOW", 10).await, [ids[2], ids[0]]);
    assert_eq!(search("TOW", 1).await, [ids[2]]);
    assert_eq!(search(&ids[1].to_string(), 10).await, [ids[1]]);
    for text in ["nowhere", "%", "\0", "'"] {
        assert!(search(text, 10).await.is_empty(), "{text:?}");
    }
}

async fn a_request_that_is_done_again_finds_its_job(fixture: &Fixture) {
    let store = fixture.open().await;
    let running = || {
        let progress = Progress::Running { process: Uuid::now_v7(), job: None };
        IdempotencyRecord { fingerprint: Digest::of(b"request"), at: Timestamp::now(), progress }
    };
    let reserve = async || {
        store.reserve_request("r", running(), Timestamp::UNIX_EPOCH).await.unwrap();
    };
    let _pin = store.put_blob(Digest::of(b"frame"), "frame".into()).await.unwrap();
    reserve().await;
    let first = record("m", b"frame");
    let id = first.job.id;
    assert_eq!(store.submit_once(first, 10, "r").await.unwrap(), None);
    let again = store.submit_once(record("m", b"frame"), 10, "r").await.unwrap();
    assert_eq!(again.unwrap().id, id);
    assert_eq!(store.queued().await.unwrap(), 1);
    // Another request has a job of its own; so has one that nobody remembers.
    assert_eq!(store.submit_once(record("m", b"frame"), 10, "other").await.unwrap(), None);
    store.forget_request("r").await.unwrap();
    reserve().await;
    assert_eq!(store.submit_once(record("m", b"frame"), 10, "r").await.unwrap(), None);
    assert_eq!(store.queued().await.unwrap(), 3);
    let full = store.submit_once(record("m", b"frame"), 3, "third").await;
    assert!(matches!(full, Err(StoreError::QueueFull { limit: 3 })));
}
