//! What a check finds out about servers that can do less than others.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use serde_json::{Value, json};
use whereabouts_testkit::mock_mllm::{MockMllm, Purpose, RawCall};

use super::super::settings::tests::defaults;
use super::*;

fn refusal(status: u16, message: &str) -> Reply {
    let body = json!({"error": {"message": message}}).to_string();
    Reply::Raw { status, headers: vec![], body }
}

/// Answers calls that contain what a server refuses.
fn refusing(
    status: u16,
    message: &'static str,
    refused: impl Fn(&Value) -> bool + Send + Sync + 'static,
) -> Script {
    let intercept = move |call: &RawCall<'_>| refused(call.body).then(|| refusal(status, message));
    Script { intercept: Box::new(intercept), ..Script::default() }
}

async fn checked(script: Script) -> (MockMllm, CheckedServer) {
    let mock = MockMllm::start(script).await;
    let settings = MllmSettings { base_url: mock.url(), ..defaults() };
    let [server] = check(&settings).await.unwrap().try_into().unwrap();
    (mock, server)
}

#[tokio::test]
async fn a_server_that_can_do_everything_is_asked_a_few_times() {
    let (mock, checked) = checked(Script::default()).await;
    assert!(checked.findings.iter().all(|finding| finding.ok), "{:?}", checked.findings);
    let can = checked.server.capabilities;
    assert_eq!((can.two_pictures, can.answer_format.as_str()), (Some(true), "bounded_schema"));
    assert!(can.temperature && can.system_message && can.checked_at.is_some());
    assert_eq!((can.calls_at_once, checked.server.trouble), (32, None));
    assert!(mock.checks() <= 6, "{}", mock.checks());
}

#[tokio::test]
async fn of_what_is_left_out_at_once_only_what_is_refused_stays_left_out() {
    let (_, of_temperature) =
        checked(refusing(400, "no", |body| body.get("temperature").is_some())).await;
    let can = of_temperature.server.capabilities;
    assert_eq!((can.temperature, can.system_message), (false, true));
    assert_eq!(can.max_tokens_field.as_deref(), Some("max_completion_tokens"));
    assert_eq!(can.answer_format, "bounded_schema");

    let (_, of_format) =
        checked(refusing(422, "no", |body| body["response_format"]["type"] == "json_schema")).await;
    let can = of_format.server.capabilities;
    assert_eq!((can.temperature, can.answer_format.as_str()), (true, "json_object"));

    let (_, of_field) =
        checked(refusing(400, "no", |body| body.get("max_completion_tokens").is_some())).await;
    let can = of_field.server.capabilities;
    assert_eq!(can.max_tokens_field.as_deref(), Some("max_tokens"));
}

#[tokio::test]
async fn a_server_that_turns_calls_away_while_it_is_busy_gets_one_at_a_time() {
    let calls = AtomicUsize::new(0);
    // After a picture call, a ranking and a call alone, three are made at once.
    let script = Script {
        intercept: Box::new(move |_| {
            let number = calls.fetch_add(1, Ordering::Relaxed);
            (4..6).contains(&number).then(|| refusal(503, "no slot available"))
        }),
        ..Script::default()
    };
    let (_, checked) = checked(script).await;
    assert_eq!(checked.server.capabilities.calls_at_once, 1, "{:?}", checked.findings);
}

fn pictures(body: &Value) -> usize {
    body.to_string().matches("\"image_url\":{").count()
}

#[tokio::test]
async fn a_server_that_takes_one_picture_gets_both_side_by_side_in_one() {
    let script = Script {
        intercept: Box::new(|call| match (call.purpose, pictures(call.body)) {
            (_, 2) => Some(refusal(400, "At most 1 image(s) may be provided in one request.")),
            (Purpose::Describe, 1) => Some(Reply::Said(notes("walls"))),
            _ => None,
        }),
        ..Script::default()
    };
    let bench = Bench::new(script).await;
    bench.refiner.check_in_background();
    let refinement = bench.refine(4).await.unwrap();
    assert_eq!((refinement.degraded, refinement.descriptions.len()), (None, 4));
    assert_eq!(bench.mock.arrived(Purpose::Describe), 4);
    let [server] = bench.refiner.servers().try_into().unwrap();
    assert_eq!((server.capabilities.two_pictures, server.suspended), (Some(false), false));
}

/// A gateway whose model is still loading, as it is where both start together.
#[tokio::test]
async fn a_server_that_did_not_answer_its_check_is_checked_with_a_later_job() {
    let is_loading = Arc::new(AtomicBool::new(true));
    let loading = Arc::clone(&is_loading);
    let script = Script {
        intercept: Box::new(move |call| match (call.purpose, pictures(call.body)) {
            _ if loading.load(Ordering::Relaxed) => Some(refusal(502, "the model is loading")),
            (_, 2) => Some(refusal(400, "At most 1 image(s) may be provided in one request.")),
            (Purpose::Describe, 1) => Some(Reply::Said(notes("walls"))),
            _ => None,
        }),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| settings.breaker_open_s = 1).await;
    bench.refiner.check_in_background();
    let first = bench.refine(4).await;
    assert!(first.is_err() || first.is_ok_and(|refinement| refinement.degraded.is_some()));
    is_loading.store(false, Ordering::Relaxed);
    let described = async {
        loop {
            match bench.refine(4).await {
                Ok(refinement) if refinement.degraded.is_none() => break refinement.descriptions,
                // The breaker is open until its time is over.
                _ => tokio::time::sleep(Duration::from_millis(50)).await,
            }
        }
    };
    let described = tokio::time::timeout(Duration::from_secs(20), described).await.unwrap();
    assert_eq!(described.len(), 4);
    let [server] = bench.refiner.servers().try_into().unwrap();
    assert_eq!(server.capabilities.two_pictures, Some(false));
}

#[tokio::test]
async fn a_server_that_cannot_be_used_says_what_to_do() {
    let (_, blind) = checked(refusing(400, "At most", |body| pictures(body) >= 1)).await;
    let finding = blind.findings.iter().find(|finding| !finding.ok).unwrap();
    let told = "the model takes no pictures";
    assert!(finding.detail.contains(told) && finding.detail.contains("At most"), "{finding:?}");
    assert!(blind.server.suspended);
    let (mock, checked) = checked(refusing(401, "no such key", |_| true)).await;
    assert_eq!(checked.server.trouble.unwrap().kind, "key");
    assert_eq!((checked.findings.len(), mock.checks()), (1, 0));
}
