use bytes::Bytes;

use super::Fixture;
use crate::LocalizeRequest;
use whereabouts_api::{ErrorKind, RefineMode};
use whereabouts_core::{Priority, RefinerKind};

fn request(k: Option<usize>, frame: &'static [u8]) -> LocalizeRequest {
    LocalizeRequest {
        map: "yard".parse().unwrap(),
        k,
        refine: RefineMode::Off,
        refiner: None,
        priority: Priority::default(),
        frame: Bytes::from_static(frame),
        deadline: None,
        track: None,
        idempotency_id: None,
    }
}

#[tokio::test]
async fn a_request_out_of_bounds_is_refused_before_its_frame_is_decoded() {
    let fixture = Fixture::new().await;
    let localizer = &fixture.service.localizer;
    for k in [0, 21] {
        let refused = localizer.localize(request(Some(k), b"frame")).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Unprocessable);
        assert!(refused.detail.contains("between 1 and 20"), "{refused}");
    }
    let refused = localizer.localize(request(None, b"")).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Malformed);
}

#[tokio::test]
async fn a_refiner_that_is_not_allowed_is_refused_before_the_frame_is_decoded() {
    let fixture = Fixture::new().await;
    let localizer = &fixture.service.localizer;
    let asking = |refiner, refine| LocalizeRequest {
        refiner: Some(refiner),
        refine,
        ..request(None, b"frame")
    };
    let refused = localizer.localize(asking(RefinerKind::Mllm, RefineMode::Async)).await;
    let refused = refused.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Forbidden);
    assert!(refused.detail.contains("allowed: local"), "{refused}");
    let refused = localizer.localize(asking(RefinerKind::Local, RefineMode::Off)).await;
    assert_eq!(refused.unwrap_err().kind, ErrorKind::Malformed);
}

#[tokio::test]
async fn a_map_that_does_not_exist_or_lacks_its_model_cannot_be_localized_in() {
    let fixture = Fixture::new().await;
    let localizer = &fixture.service.localizer;
    let refused = localizer.localize(request(None, b"frame")).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::NotFound);
    fixture.map("yard", &[None]).await;
    let refused = localizer.localize(request(None, b"frame")).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Conflict);
    assert!(refused.detail.contains("not-installed"), "{refused}");
}

#[tokio::test]
async fn a_full_queue_rejects_a_caller_that_waits_for_the_job_before_any_other_check() {
    let fixture = Fixture::new().await;
    let localizer = &fixture.service.localizer;
    for _ in 0..localizer.submitter.settings.queue {
        fixture.job("yard").await;
    }
    let waiting = LocalizeRequest { refine: RefineMode::Wait, ..request(None, b"frame") };
    let refused = localizer.localize(waiting).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Overloaded);
    assert!(refused.retry_after.is_some());
}
