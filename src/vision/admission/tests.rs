//! Who waits, who goes first, who is refused.

use std::pin::Pin;

use futures_util::poll;

use super::*;

type Entering = Pin<Box<dyn Future<Output = Result<Permit, Rejected>>>>;

fn admission(permits: usize, queue: usize) -> Admission {
    Admission::new(AdmissionSettings {
        permits,
        queue,
        max_wait: Duration::from_secs(60),
        max_retry_after: Duration::from_secs(30),
    })
}

fn demand(class: WorkClass) -> AdmissionRequest {
    AdmissionRequest { class, deadline: None }
}

/// Joins the line; whoever is refused at once fails the test.
async fn waiting(admission: &Admission, class: WorkClass) -> Entering {
    let admission = admission.clone();
    let mut entering: Entering = Box::pin(async move { admission.acquire(demand(class)).await });
    assert!(poll!(&mut entering).is_pending());
    entering
}

async fn reason(admission: &Admission, demand: AdmissionRequest) -> RejectReason {
    admission.acquire(demand).await.unwrap_err().reason
}

#[tokio::test]
async fn one_more_than_may_wait_is_refused_at_once() {
    let admission = admission(1, 2);
    let _inside = admission.acquire(demand(WorkClass::Localize)).await.unwrap();
    let _a = waiting(&admission, WorkClass::Localize).await;
    let _b = waiting(&admission, WorkClass::Localize).await;
    assert_eq!(reason(&admission, demand(WorkClass::Localize)).await, RejectReason::QueueFull);
    assert_eq!(reason(&admission, demand(WorkClass::Index)).await, RejectReason::QueueFull);
    assert!(admission.check(demand(WorkClass::Localize)).is_err());
    assert_eq!(admission.pressure(), 1.0);
}

#[tokio::test]
async fn frames_go_first_then_images_then_what_nobody_waits_for() {
    let admission = admission(1, 9);
    let inside = admission.acquire(demand(WorkClass::Index)).await.unwrap();
    let mut background = waiting(&admission, WorkClass::Background).await;
    let mut index = waiting(&admission, WorkClass::Index).await;
    let mut localize = waiting(&admission, WorkClass::Localize).await;
    drop(inside);
    assert!(poll!(&mut index).is_pending() && poll!(&mut background).is_pending());
    drop(localize.as_mut().await.unwrap());
    assert!(poll!(&mut background).is_pending());
    drop(index.as_mut().await.unwrap());
    drop(background.as_mut().await.unwrap());
    assert_eq!(admission.levels(), AdmissionLevels { permits: 1, ..Default::default() });
}

#[tokio::test]
async fn the_last_image_makes_room_for_a_frame() {
    let admission = admission(1, 2);
    let _inside = admission.acquire(demand(WorkClass::Localize)).await.unwrap();
    let mut first = waiting(&admission, WorkClass::Index).await;
    let last = waiting(&admission, WorkClass::Index).await;
    let _frame = waiting(&admission, WorkClass::Localize).await;
    assert_eq!(last.await.unwrap_err().reason, RejectReason::QueueFull);
    assert!(poll!(&mut first).is_pending());
}

#[tokio::test]
async fn the_place_of_who_has_gone_is_free() {
    let admission = admission(1, 1);
    let inside = admission.acquire(demand(WorkClass::Localize)).await.unwrap();
    drop(waiting(&admission, WorkClass::Localize).await);
    let mut next = waiting(&admission, WorkClass::Localize).await;
    drop(inside);
    drop(next.as_mut().await.unwrap());
    assert_eq!(admission.levels().in_use, 0);
}

#[tokio::test(start_paused = true)]
async fn nobody_waits_longer_than_the_bound_but_in_the_background() {
    let admission = admission(1, 2);
    let inside = admission.acquire(demand(WorkClass::Localize)).await.unwrap();
    let mut background = waiting(&admission, WorkClass::Background).await;
    let frame = waiting(&admission, WorkClass::Localize).await;
    assert_eq!(frame.await.unwrap_err().reason, RejectReason::WaitTooLong);
    assert!(poll!(&mut background).is_pending());
    drop(inside);
    assert!(background.await.is_ok());
}

#[tokio::test]
async fn what_cannot_be_in_time_is_refused_at_once_and_told_when_to_come_back() {
    let admission = admission(1, 100);
    let mut inside = admission.acquire(demand(WorkClass::Localize)).await.unwrap();
    inside.since = Instant::now() - Duration::from_secs(4);
    inside.complete();
    let soon = AdmissionRequest {
        class: WorkClass::Localize,
        deadline: Some(Instant::now() + Duration::from_secs(5)),
    };
    let refused = admission.acquire(soon).await.unwrap_err();
    assert_eq!(refused.reason, RejectReason::DeadlineTooSoon);
    assert_eq!(refused.retry_after.as_secs(), 4);
    let mut in_line = Vec::new();
    for _ in 0..14 {
        in_line.push(waiting(&admission, WorkClass::Localize).await);
    }
    let refused = admission.acquire(demand(WorkClass::Localize)).await.unwrap_err();
    assert_eq!(refused.reason, RejectReason::WaitTooLong);
    assert_eq!(refused.retry_after.as_secs(), 30);
    // Who is alone is tried, whatever took long before.
    in_line.clear();
    drop(inside);
    assert!(admission.acquire(soon).await.is_ok());
}
