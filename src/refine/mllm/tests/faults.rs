//! Faults of the server and of the connection.

use super::shelf::KEY;
use super::*;

/// Answers the first describe calls with these faults.
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
async fn transient_faults_are_retried() {
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
async fn a_hanging_call_times_out_and_is_retried() {
    let bench = Bench::with(after(vec![Reply::Hang]), |settings| settings.timeout_s = 1).await;
    let refinement = bench.refine(1).await.unwrap();
    assert_eq!(refinement.degraded, None);
    assert_eq!(bench.mock.describe_calls(), 2);
}

#[tokio::test]
async fn dropping_a_job_closes_its_connections() {
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
async fn an_answer_above_the_size_limit_is_rejected() {
    let bench = Bench::new(after(vec![Reply::Huge(10_000_000)])).await;
    let error = bench.refine(1).await.unwrap_err();
    assert!(matches!(&error, RefineError::Permanent(why) if why.contains("answer_max_bytes")));
    assert_eq!(bench.mock.describe_calls(), 1);
}

#[tokio::test]
async fn a_pair_without_a_description_keeps_its_coarse_place() {
    let refused = std::sync::OnceLock::new();
    let script = Script {
        // The pair is asked for twice.
        describe: Box::new(move |call| match call.number {
            2 => {
                refused.set(call.pair.clone()).unwrap();
                Reply::Said("I'm sorry, but I can't help with that.".into())
            }
            number if number < 5 && refused.get() == Some(&call.pair) => {
                Reply::Said("I'm sorry, but I can't help with that.".into())
            }
            number => Reply::Text(format!("notes number {number}.")),
        }),
        reason: Box::new(|call| ranking(&call.labels_with_first("number 5."))),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| {
        settings.concurrency = 1;
        settings.hide_coarse_rank = false;
    })
    .await;
    let refinement = bench.refine(4).await.unwrap();
    assert_eq!(ranks(&refinement), [4, 2, 1, 3]);
    assert_eq!(refinement.descriptions.len(), 3);
    let why = refinement.degraded.unwrap();
    assert!(
        why.starts_with("1 of 4 pairs could not be described") && why.contains("refused"),
        "{why}"
    );
    // It was not cached, and is asked for again.
    bench.refine(4).await.unwrap();
    assert_eq!(bench.mock.describe_calls(), 5 + 1);
}

#[tokio::test]
async fn without_any_description_the_fallback_refines_and_without_it_the_job_fails() {
    let always =
        |reply: Reply| Script { describe: Box::new(move |_| reply.clone()), ..Script::default() };
    let bench = Bench::new(always(status(404))).await;
    assert!(matches!(bench.refine(2).await.unwrap_err(), RefineError::Transient(_)));
    assert_eq!(bench.mock.describe_calls(), 1);
    let bench = Bench::with(always(status(500)), |settings| settings.breaker_failures = 100).await;
    assert!(matches!(bench.refine(2).await.unwrap_err(), RefineError::Transient(_)));
    assert_eq!(bench.mock.describe_calls(), 8);
    let mut bench = Bench::new(always(Reply::Said(" \u{200b}\n".into()))).await;
    let error = bench.refine(1).await.unwrap_err();
    assert!(error.to_string().contains("said nothing"), "{error}");
    assert_eq!(bench.mock.describe_calls(), 2);
    bench.fallback = Some(Arc::new(limits::Reverse));
    bench.rebuild(|_| {});
    let refinement = bench.refine(2).await.unwrap();
    assert_eq!(ranks(&refinement), [2, 1]);
    assert!(refinement.degraded.unwrap().contains("said nothing"));
}

#[tokio::test]
async fn after_a_failed_reasoning_call_the_order_is_the_fallbacks_and_the_descriptions_stay() {
    let script = Script {
        reason: Box::new(|call| match call.number {
            number if number <= 10 => status(500),
            _ => ranking(&call.labels()),
        }),
        ..Script::default()
    };
    let mut bench = Bench::with(script, |settings| settings.breaker_failures = 100).await;
    let refinement = bench.refine(3).await.unwrap();
    assert_eq!(ranks(&refinement), [1, 2, 3]);
    assert!(refinement.degraded.unwrap().contains("all candidates are in coarse order"));
    assert_eq!((refinement.usage.calls, refinement.descriptions.len()), (3, 3));

    bench.fallback = Some(Arc::new(limits::Reverse));
    bench.rebuild(|_| {});
    let refinement = bench.refine(3).await.unwrap();
    assert_eq!(ranks(&refinement), [3, 2, 1]);
    let why = refinement.degraded.unwrap();
    assert!(why.contains("the order is that of `local`") && why.contains("on purpose"), "{why}");
    assert_eq!((refinement.usage.cached, refinement.descriptions.len()), (3, 3));

    // The reasoning is tried again later, at no new description.
    let refinement = bench.refine(3).await.unwrap();
    assert_eq!((refinement.degraded, bench.mock.describe_calls()), (None, 3));
}

#[tokio::test]
async fn a_schema_is_not_sent_again_after_the_server_rejected_it() {
    let script = Script { structured: false, ..Script::default() };
    let bench = Bench::new(script).await;
    for _ in 0..3 {
        assert_eq!(bench.refine(2).await.unwrap().degraded, None);
    }
    // A schema with bounds, one without, and any object.
    assert_eq!((bench.mock.structure_refused(), bench.mock.reason_calls()), (3, 3));
}

#[tokio::test]
async fn the_key_is_hidden_in_error_messages() {
    let message = format!("Incorrect API key provided: {KEY}");
    let script = Script {
        describe: Box::new(move |_| Reply::Status(401, message.clone())),
        ..Script::default()
    };
    let bench = Bench::new(script).await;
    let error = bench.refine(1).await.unwrap_err();
    let shown = format!("{error} {error:?} {:?}", bench.settings);
    assert!(shown.contains("Incorrect API key provided: [hidden]"), "{shown}");
    assert!(!shown.contains(KEY), "{shown}");
}

#[tokio::test]
async fn an_unreachable_server_is_a_transient_error() {
    let mut bench = Bench::new(Script::default()).await;
    bench.rebuild(|settings| settings.base_url = "http://127.0.0.1:1/v1".into());
    let error = bench.refine(1).await.unwrap_err();
    assert!(matches!(&error, RefineError::Transient(why) if why.contains("cannot be reached")));
}

#[tokio::test]
async fn a_model_that_refuses_every_pair_is_trouble_until_it_describes_one() {
    let refuses = Arc::new(std::sync::atomic::AtomicBool::new(true));
    let refusing = Arc::clone(&refuses);
    let script = Script {
        describe: Box::new(move |_| match refusing.load(std::sync::atomic::Ordering::Relaxed) {
            true => Reply::Said("I'm sorry, but I can't help with that.".into()),
            false => Reply::Text("notes".into()),
        }),
        ..Script::default()
    };
    let mut bench = Bench::new(script).await;
    bench.fallback = Some(Arc::new(limits::Reverse));
    bench.rebuild(|_| {});
    bench.refine(3).await.unwrap();
    let [server] = bench.refiner.servers().try_into().unwrap();
    let trouble = server.trouble.unwrap();
    assert_eq!((trouble.kind.as_str(), server.suspended), ("no_answer", false));
    assert!(trouble.message.contains("refused"), "{trouble:?}");

    refuses.store(false, std::sync::atomic::Ordering::Relaxed);
    bench.refine(3).await.unwrap();
    let [server] = bench.refiner.servers().try_into().unwrap();
    assert_eq!(server.trouble, None);
}

#[tokio::test]
async fn a_failed_reasoning_call_is_tried_again_with_the_job_at_no_new_description() {
    let script = Script {
        reason: Box::new(|call| match call.number {
            // Four attempts, and one more without a format of the answer.
            number if number <= 5 => status(500),
            _ => ranking(&call.labels()),
        }),
        ..Script::default()
    };
    let mut bench = Bench::with(script, |settings| settings.breaker_failures = 100).await;
    bench.fallback = Some(Arc::new(limits::Reverse));
    bench.rebuild(|_| {});
    let mut input = bench.input(3);
    input.attempts_left = 1;
    let error = bench.refiner.refine(&input, &Steps::default()).await.unwrap_err();
    assert!(
        matches!(&error, RefineError::Transient(why) if why.contains("descriptions are kept")),
        "{error}"
    );
    input.attempts_left = 0;
    let refinement = bench.refiner.refine(&input, &Steps::default()).await.unwrap();
    assert_eq!((refinement.degraded, bench.mock.describe_calls()), (None, 3));
}
