use futures_util::FutureExt;
use uuid::Uuid;

use super::{Fixture, candidates, descriptor, map};
use crate::submit::{JobWish, LocalizedFrame, Submission};
use crate::{Chosen, ServiceError, Submitter};
use whereabouts_api::{ErrorKind, NoJobReason};
use whereabouts_core::{DenseFeatures, Digest, MediaType, Priority, RefinerKind};
use whereabouts_vision::{AdmissionRequest, WorkClass};

fn frame() -> LocalizedFrame {
    LocalizedFrame {
        query_id: Uuid::now_v7(),
        bytes: b"frame".as_slice().into(),
        model: Digest::of(b"model"),
        digest: Digest::of(b"frame"),
        media_type: MediaType::Jpeg,
        descriptor: descriptor(0),
        uninformative: None,
        dense: Some(DenseFeatures::new(1, 1, 1, vec![1.0], None).unwrap()),
    }
}

async fn submit(submitter: &Submitter, request: Option<&str>) -> Result<Submission, ServiceError> {
    let found = candidates(&[(0, 0.9)]);
    submitter.submit(&map("yard"), frame(), found, wish(), request).await
}

fn wish() -> JobWish {
    JobWish { chosen: Chosen::Refiner(RefinerKind::Local), priority: Priority::default() }
}

fn reason(submission: Submission) -> Option<NoJobReason> {
    match submission {
        Submission::Queued(_) => None,
        Submission::Declined(why) => Some(why.reason),
    }
}

#[tokio::test]
async fn a_frame_gets_a_queued_job_with_its_candidates() {
    let fixture = Fixture::new().await;
    let submitter = &fixture.service.localizer.submitter;
    let Submission::Queued(job) = submit(submitter, None).await.unwrap() else {
        panic!("declined")
    };
    let record = submitter.jobs.job(job.id).await.unwrap().unwrap();
    assert_eq!(record.job, *job);
    assert_eq!(record.candidates, candidates(&[(0, 0.9)]));
    assert_eq!(record.query.descriptor, None, "this refiner does not use it");
    let (_, bytes) = fixture.service.jobs.frame(job.id, None).await.unwrap();
    assert_eq!(bytes, "frame");
}

#[tokio::test]
async fn without_a_refiner_or_candidates_there_is_no_job() {
    let fixture = Fixture::new().await;
    let submitter = fixture.service.localizer.submitter.clone();
    let yard = map("yard");
    let submission = submitter.submit(&yard, frame(), vec![], wish(), None);
    assert_eq!(reason(submission.await.unwrap()), Some(NoJobReason::EmptyMap));
    let submitter = Submitter { refiner: None, ..submitter };
    let submission = submit(&submitter, None).await.unwrap();
    assert_eq!(reason(submission), Some(NoJobReason::NoRefiner));
    submitter.check_capacity().await.unwrap();
    assert_eq!(submitter.jobs.queued().await.unwrap(), 0);
}

#[tokio::test]
async fn a_full_queue_declines_jobs_and_rejects_callers_that_wait_for_one() {
    let fixture = Fixture::new().await;
    let submitter = &fixture.service.localizer.submitter;
    for _ in 0..submitter.settings.queue {
        submitter.check_capacity().await.unwrap();
        assert_eq!(reason(submit(submitter, None).await.unwrap()), None);
    }
    let declined = submit(submitter, None).await.unwrap();
    assert_eq!(reason(declined), Some(NoJobReason::QueueFull));
    let rejected = submitter.check_capacity().await.unwrap_err();
    assert_eq!(rejected.kind, ErrorKind::Overloaded);
    assert!(rejected.detail.contains("refine=off"), "{rejected}");
    assert!(rejected.retry_after.is_some());
    assert_eq!(submitter.jobs.queued().await.unwrap(), submitter.settings.queue);
}

#[tokio::test]
async fn jobs_are_shed_while_images_wait_for_admission() {
    let fixture = Fixture::new().await;
    let submitter = &fixture.service.localizer.submitter;
    let request = AdmissionRequest { class: WorkClass::Localize, deadline: None };
    let permit = submitter.admission.acquire(request).await.unwrap();
    {
        let mut waiting = Box::pin(submitter.admission.acquire(request));
        assert!((&mut waiting).now_or_never().is_none(), "there is one permit only");
        let declined = submit(submitter, None).await.unwrap();
        assert_eq!(reason(declined), Some(NoJobReason::Overload));
        assert_eq!(submitter.check_capacity().await.unwrap_err().kind, ErrorKind::Overloaded);
    }
    drop(permit);
    submitter.check_capacity().await.unwrap();
    assert_eq!(reason(submit(submitter, None).await.unwrap()), None);
}

#[tokio::test]
async fn a_full_disk_declines_jobs() {
    let fixture = Fixture::with(u64::MAX, |_| {}).await;
    let submitter = &fixture.service.localizer.submitter;
    let declined = submit(submitter, None).await.unwrap();
    assert_eq!(reason(declined), Some(NoJobReason::DiskFull));
}

#[tokio::test]
async fn a_request_sent_again_gets_the_job_of_its_first_attempt() {
    let fixture = Fixture::new().await;
    let submitter = &fixture.service.localizer.submitter;
    fixture.service.idempotency.begin("key", Digest::of(b"body")).await.unwrap();
    let Submission::Queued(first) = submit(submitter, Some("key")).await.unwrap() else {
        panic!("declined")
    };
    let Submission::Queued(second) = submit(submitter, Some("key")).await.unwrap() else {
        panic!("declined")
    };
    assert_eq!(first.id, second.id);
    assert_eq!(submitter.jobs.queued().await.unwrap(), 1);
}
