use std::time::Duration;

use futures_util::StreamExt;
use tokio::time::Instant;
use uuid::Uuid;

use super::Fixture;
use crate::{AnyJobEvent, JobEvent, parse_search_text, uuid};
use whereabouts_api::ErrorKind;
use whereabouts_core::JobState;
use whereabouts_store::JobFilter;

#[tokio::test]
async fn an_unknown_job_is_not_found() {
    let fixture = Fixture::new().await;
    let (jobs, id) = (&fixture.service.jobs, Uuid::now_v7());
    let kinds = [
        jobs.get(id, None).await.unwrap_err().kind,
        jobs.get(id, Some(Duration::from_secs(1))).await.unwrap_err().kind,
        jobs.cancel(id).await.unwrap_err().kind,
        jobs.retry(id, false).await.unwrap_err().kind,
        jobs.frame(id, None).await.unwrap_err().kind,
        jobs.matches(id, &super::image_id(0)).await.unwrap_err().kind,
        jobs.follow(id).await.err().unwrap().kind,
    ];
    assert_eq!(kinds, [ErrorKind::NotFound; 7]);
}

#[tokio::test]
async fn a_cancelled_job_ends_and_can_be_queued_again() {
    let fixture = Fixture::new().await;
    let (jobs, job) = (&fixture.service.jobs, fixture.job("yard").await);
    assert_eq!(jobs.get(job.id, None).await.unwrap().state, JobState::Queued);
    assert_eq!(jobs.retry(job.id, false).await.unwrap_err().kind, ErrorKind::Conflict);
    assert_eq!(jobs.cancel(job.id).await.unwrap().state, JobState::Cancelled);
    assert_eq!(jobs.open().await.unwrap(), 0);
    assert_eq!(jobs.oldest_age().await.unwrap(), Duration::ZERO);
    assert_eq!(jobs.retry(job.id, false).await.unwrap().state, JobState::Queued);
    assert_eq!(jobs.open().await.unwrap(), 1);
}

#[tokio::test]
async fn the_frame_of_a_job_is_returned_as_it_was_sent() {
    let fixture = Fixture::new().await;
    let job = fixture.job("yard").await;
    let (_, bytes) = fixture.service.jobs.frame(job.id, None).await.unwrap();
    assert_eq!(bytes, &job.id.as_bytes()[..]);
}

#[tokio::test(start_paused = true)]
async fn a_wait_is_bounded_by_the_caller_and_by_the_server() {
    let fixture = Fixture::new().await;
    let (jobs, job) = (&fixture.service.jobs, fixture.job("yard").await);
    let began = Instant::now();
    let waited = jobs.get(job.id, Some(Duration::from_secs(7))).await.unwrap();
    assert_eq!(waited.state, JobState::Queued);
    assert!((7..8).contains(&began.elapsed().as_secs()), "{:?}", began.elapsed());
    let refused = jobs.get(job.id, Some(Duration::from_secs(61))).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Unprocessable);
    assert!(refused.detail.contains("60 seconds"), "{refused}");
}

#[tokio::test]
async fn a_wait_ends_with_the_job() {
    let fixture = Fixture::new().await;
    let (jobs, job) = (&fixture.service.jobs, fixture.job("yard").await);
    let other = fixture.job("yard").await;
    let began = Instant::now();
    let (waited, _) = tokio::join!(jobs.get(job.id, Some(Duration::from_secs(60))), async {
        // A change of another job does not end the wait.
        jobs.cancel(other.id).await.unwrap();
        jobs.cancel(job.id).await.unwrap();
    });
    assert_eq!(waited.unwrap().state, JobState::Cancelled);
    assert!(began.elapsed() < Duration::from_secs(60));
}

#[tokio::test]
async fn jobs_are_listed_newest_first_a_page_at_a_time() {
    let fixture = Fixture::new().await;
    let jobs = &fixture.service.jobs;
    let mut ids = Vec::new();
    for map in ["yard", "hall", "yard"] {
        ids.insert(0, fixture.job(map).await.id);
    }
    let list = |filter, cursor| jobs.list(filter, cursor, Some(2));
    let first = list(JobFilter::default(), None).await.unwrap();
    let listed: Vec<_> = first.jobs.iter().map(|job| job.id).collect();
    assert_eq!(listed, ids[..2]);
    let last = list(JobFilter::default(), first.next_cursor).await.unwrap();
    assert_eq!((last.jobs[0].id, last.jobs.len(), last.next_cursor), (ids[2], 1, None));

    let in_hall = JobFilter { map: Some("hall".parse().unwrap()), ..JobFilter::default() };
    let listed = list(in_hall, None).await.unwrap().jobs;
    assert_eq!((listed[0].id, listed.len()), (ids[1], 1));
    let with_text = JobFilter { text: Some("HALL".into()), ..JobFilter::default() };
    assert_eq!(list(with_text, None).await.unwrap().jobs, listed);
    for limit in [0, 1001] {
        let refused = jobs.list(JobFilter::default(), None, Some(limit)).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Unprocessable);
    }
}

#[test]
fn a_search_text_is_trimmed_and_bounded() {
    assert_eq!(parse_search_text(" door ").unwrap().as_deref(), Some("door"));
    assert_eq!(parse_search_text("  ").unwrap(), None);
    assert!(parse_search_text(&"ö".repeat(200)).unwrap().is_some());
    assert_eq!(parse_search_text(&"ö".repeat(201)).unwrap_err().kind, ErrorKind::Malformed);
}

#[test]
fn a_text_that_is_not_a_uuid_is_malformed_and_quoted_in_part() {
    let refused = uuid("job", &"x".repeat(1000)).unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Malformed);
    assert!(refused.detail.contains("job id") && refused.detail.len() < 200, "{refused}");
}

#[tokio::test]
async fn a_followed_job_reports_its_state_and_then_its_end() {
    let fixture = Fixture::new().await;
    let (jobs, job) = (&fixture.service.jobs, fixture.job("yard").await);
    let mut events = Box::pin(jobs.follow(job.id).await.unwrap());
    let mut in_hall = Box::pin(jobs.follow_all(Some("hall".parse().unwrap())));
    let mut in_yard = Box::pin(jobs.follow_all(Some("yard".parse().unwrap())));
    let Some(JobEvent::State(status)) = events.next().await else { panic!("no state") };
    assert_eq!(status.state, JobState::Queued);
    jobs.cancel(job.id).await.unwrap();
    let Some(JobEvent::Ended(ended)) = events.next().await else { panic!("no end") };
    assert_eq!((ended.id, ended.state), (job.id, JobState::Cancelled));
    assert_eq!(events.next().await, None);

    let hall = fixture.job("hall").await;
    for (stream, id) in [(&mut in_yard, job.id), (&mut in_hall, hall.id)] {
        let Some(AnyJobEvent::Changed(change)) = stream.next().await else { panic!("no change") };
        assert_eq!(change.id, id);
    }
}
