//! What goes wrong on the way to a server and back.

use super::shelf::KEY;
use super::*;

/// Answers the first describe calls with a fault each.
fn after(faults: Vec<Reply>) -> Script {
    Script {
        describe: Box::new(move |call| match faults.get(call.number - 1) {
            Some(fault) => fault.clone(),
            None => Reply::Text("notes".into()),
        }),
        ..Script::default()
    }
}

fn status(code: u16) -> Reply {
    Reply::Status(code, "on purpose".into())
}

#[tokio::test]
async fn what_may_pass_is_tried_again() {
    let faults = [
        Reply::Busy("0".into()),
        status(500),
        status(503),
        Reply::Cut,
        Reply::HalfBody,
        Reply::NotJson,
    ];
    for fault in faults {
        let bench = Bench::new(after(vec![fault])).await;
        let refinement = bench.refine(2).await.unwrap();
        assert_eq!(refinement.degraded, None);
        assert_eq!(bench.mock.describe_calls(), 3);
        assert_eq!(bench.mock.asked_again(), 0);
    }
}

#[tokio::test]
async fn a_call_that_hangs_is_given_up_at_its_deadline() {
    let bench = Bench::with(after(vec![Reply::Hang]), |settings| settings.timeout_s = 1).await;
    let refinement = bench.refine(1).await.unwrap();
    assert_eq!(refinement.degraded, None);
    assert_eq!(bench.mock.describe_calls(), 2);
}

#[tokio::test]
async fn dropping_a_job_hangs_up() {
    let bench = Bench::new(after(vec![Reply::Hang; 3])).await;
    {
        let mut job = Box::pin(bench.refine(3));
        while bench.mock.in_flight() < 3 {
            assert!(futures_util::poll!(&mut job).is_pending());
            tokio::task::yield_now().await;
        }
    }
    while bench.mock.in_flight() > 0 {
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn an_answer_of_ten_megabytes_is_refused() {
    let bench = Bench::new(after(vec![Reply::Huge(10_000_000)])).await;
    let error = bench.refine(1).await.unwrap_err();
    assert!(matches!(&error, RefineError::Permanent(why) if why.contains("answer_max_bytes")));
    assert_eq!(bench.mock.describe_calls(), 1);
}

#[tokio::test]
async fn a_pair_that_fails_for_good_is_ranked_behind_the_others() {
    let script = Script {
        describe: Box::new(|call| match call.number {
            2 => status(413),
            number => Reply::Text(format!("notes number {number}.")),
        }),
        reason: Box::new(|call| ranking(&call.labels_with_first("number 4."))),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| settings.concurrency = 1).await;
    let refinement = bench.refine(4).await.unwrap();
    let order = ranks(&refinement);
    assert_eq!((order[0], order[3]), (4, 2));
    assert_eq!(refinement.descriptions.len(), 3);
    let why = refinement.degraded.unwrap();
    assert!(why.starts_with("1 of 4 pairs could not be described") && why.contains("413"), "{why}");
}

#[tokio::test]
async fn when_no_pair_can_be_described_the_job_has_no_ranking() {
    let always =
        |reply: Reply| Script { describe: Box::new(move |_| reply.clone()), ..Script::default() };
    let bench = Bench::new(always(status(404))).await;
    assert!(matches!(bench.refine(2).await.unwrap_err(), RefineError::Permanent(_)));
    assert_eq!(bench.mock.describe_calls(), 2);
    let bench = Bench::with(always(status(500)), |settings| settings.breaker_failures = 100).await;
    assert!(matches!(bench.refine(2).await.unwrap_err(), RefineError::Transient(_)));
    assert_eq!(bench.mock.describe_calls(), 8);
    let bench = Bench::new(always(Reply::Text(" \u{200b}\n".into()))).await;
    let error = bench.refine(1).await.unwrap_err();
    assert!(error.to_string().contains("the description is empty"), "{error}");
}

#[tokio::test]
async fn when_the_reasoning_call_fails_for_good_the_order_is_the_coarse_one() {
    let script = Script { reason: Box::new(|_| status(500)), ..Script::default() };
    let bench = Bench::new(script).await;
    let refinement = bench.refine(3).await.unwrap();
    assert_eq!(ranks(&refinement), [1, 2, 3]);
    assert!(refinement.degraded.unwrap().contains("all candidates are in coarse order"));
    assert_eq!(refinement.usage.calls, 3);
}

#[tokio::test]
async fn a_server_that_takes_no_schema_is_asked_only_once() {
    let script = Script { structured: false, ..Script::default() };
    let bench = Bench::new(script).await;
    for _ in 0..3 {
        assert_eq!(bench.refine(2).await.unwrap().degraded, None);
    }
    assert_eq!((bench.mock.structure_refused(), bench.mock.reason_calls()), (1, 3));
}

#[tokio::test]
async fn the_key_is_never_repeated() {
    let said = format!("Incorrect API key provided: {KEY}");
    let script = Script {
        describe: Box::new(move |_| Reply::Status(401, said.clone())),
        ..Script::default()
    };
    let bench = Bench::new(script).await;
    let error = bench.refine(1).await.unwrap_err();
    let shown = format!("{error} {error:?} {:?}", bench.settings);
    assert!(shown.contains("Incorrect API key provided: [hidden]"), "{shown}");
    assert!(!shown.contains(KEY), "{shown}");
}

#[tokio::test]
async fn a_server_that_is_not_there_may_come_back() {
    let mut bench = Bench::new(Script::default()).await;
    bench.rebuild(|settings| settings.base_url = "http://127.0.0.1:1/v1".into());
    let error = bench.refine(1).await.unwrap_err();
    assert!(matches!(&error, RefineError::Transient(why) if why.contains("cannot be talked to")));
}
