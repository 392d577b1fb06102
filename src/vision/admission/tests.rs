//! Queueing, priorities and rejection.

use std::pin::Pin;

use futures_util::poll;

use super::*;

type Entering = Pin<Box<dyn Future<Output = Result<Permit, Rejected>>>>;

pub(super) fn admission(permits: usize, queue: usize) -> Admission {
    Admission::new(AdmissionSettings {
        permits,
        queue,
        max_wait: Duration::from_secs(60),
        max_retry_after: Duration::from_secs(30),
    })
}

pub(super) fn request(class: WorkClass) -> AdmissionRequest {
    AdmissionRequest { class, deadline: None }
}

/// Joins the queue; panics if the request is not queued.
async fn waiting(admission: &Admission, class: WorkClass) -> Entering {
    let admission = admission.clone();
    let mut entering: Entering = Box::pin(async move { admission.acquire(request(class)).await });
    assert!(poll!(&mut entering).is_pending());
    entering
}

async fn reason(admission: &Admission, request: AdmissionRequest) -> RejectReason {
    admission.acquire(request).await.unwrap_err().reason
}

#[tokio::test]
async fn a_full_queue_rejects_at_once() {
    let admission = admission(1, 2);
    let _held = admission.acquire(request(WorkClass::Localize)).await.unwrap();
    let _a = waiting(&admission, WorkClass::Localize).await;
    let _b = waiting(&admission, WorkClass::Localize).await;
    assert_eq!(reason(&admission, request(WorkClass::Localize)).await, RejectReason::QueueFull);
    assert_eq!(reason(&admission, request(WorkClass::Index)).await, RejectReason::QueueFull);
    assert!(admission.check(request(WorkClass::Localize)).is_err());
    assert_eq!(admission.pressure(), 1.0);
}

#[tokio::test]
async fn frames_go_before_images_and_images_before_background_work() {
    let admission = admission(1, 9);
    let held = admission.acquire(request(WorkClass::Index)).await.unwrap();
    let mut background = waiting(&admission, WorkClass::Background).await;
    let mut index = waiting(&admission, WorkClass::Index).await;
    let mut localize = waiting(&admission, WorkClass::Localize).await;
    drop(held);
    assert!(poll!(&mut index).is_pending() && poll!(&mut background).is_pending());
    drop(localize.as_mut().await.unwrap());
    assert!(poll!(&mut background).is_pending());
    drop(index.as_mut().await.unwrap());
    drop(background.as_mut().await.unwrap());
    assert_eq!(admission.levels(), AdmissionLevels { permits: 1, ..Default::default() });
}

#[tokio::test]
async fn the_newest_waiting_image_is_evicted_for_a_frame() {
    let admission = admission(1, 2);
    let _held = admission.acquire(request(WorkClass::Localize)).await.unwrap();
    let mut first = waiting(&admission, WorkClass::Index).await;
    let last = waiting(&admission, WorkClass::Index).await;
    let _frame = waiting(&admission, WorkClass::Localize).await;
    assert_eq!(last.await.unwrap_err().reason, RejectReason::QueueFull);
    assert!(poll!(&mut first).is_pending());
}

#[tokio::test]
async fn a_request_that_left_frees_its_slot() {
    let admission = admission(1, 1);
    let held = admission.acquire(request(WorkClass::Localize)).await.unwrap();
    drop(waiting(&admission, WorkClass::Localize).await);
    let mut next = waiting(&admission, WorkClass::Localize).await;
    drop(held);
    drop(next.as_mut().await.unwrap());
    assert_eq!(admission.levels().in_use, 0);
}

#[tokio::test(start_paused = true)]
async fn only_background_work_waits_longer_than_the_maximum() {
    let admission = admission(1, 2);
    let held = admission.acquire(request(WorkClass::Localize)).await.unwrap();
    let mut background = waiting(&admission, WorkClass::Background).await;
    let frame = waiting(&admission, WorkClass::Localize).await;
    assert_eq!(frame.await.unwrap_err().reason, RejectReason::WaitTooLong);
    assert!(poll!(&mut background).is_pending());
    drop(held);
    assert!(background.await.is_ok());
}

#[tokio::test]
async fn an_unreachable_deadline_is_rejected_at_once_with_a_retry_after() {
    let admission = admission(1, 100);
    let mut held = admission.acquire(request(WorkClass::Localize)).await.unwrap();
    held.acquired = Instant::now() - Duration::from_secs(4);
    held.complete();
    let soon = AdmissionRequest {
        class: WorkClass::Localize,
        deadline: Some(Instant::now() + Duration::from_secs(5)),
    };
    let rejected = admission.acquire(soon).await.unwrap_err();
    assert_eq!(rejected.reason, RejectReason::DeadlineTooSoon);
    assert_eq!(rejected.retry_after.as_secs(), 4);
    let mut queued = Vec::new();
    for _ in 0..14 {
        queued.push(waiting(&admission, WorkClass::Localize).await);
    }
    let rejected = admission.acquire(request(WorkClass::Localize)).await.unwrap_err();
    assert_eq!(rejected.reason, RejectReason::WaitTooLong);
    assert_eq!(rejected.retry_after.as_secs(), 30);
    // With a free permit nothing is rejected, however slow earlier work was.
    queued.clear();
    drop(held);
    assert!(admission.acquire(soon).await.is_ok());
}
