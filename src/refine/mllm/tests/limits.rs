//! Circuit breaker and budget: what becomes of a job while no call may be made.

use async_trait::async_trait;

use super::*;
use whereabouts_core::{Ranking, RefinerKind, Usage};

/// Stands in for the local refiner: reverses the coarse order.
pub struct Reverse;

#[async_trait]
impl Refiner for Reverse {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Local
    }

    async fn refine(
        &self,
        input: &RefineInput,
        _: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let order: Vec<usize> = (0..input.candidates.len()).rev().collect();
        Ok(Refinement {
            descriptions: vec![],
            ranking: Ranking::new(&input.candidates, &order).unwrap(),
            evidence: None,
            certainty: None,
            verdicts: Vec::new(),
            agreement: None,
            reasoning: None,
            reasoning_took_ms: None,
            ordered_by: None,
            usage: Usage::default(),
            degraded: None,
        })
    }
}

/// Fails the first describe calls.
fn failing(first: usize) -> Script {
    Script {
        describe: Box::new(move |call| match call.number {
            number if number <= first => Reply::Status(500, "down".into()),
            _ => Reply::Text("notes".into()),
        }),
        ..Script::default()
    }
}

/// One call at a time and without retries; three failures open the breaker.
fn brittle(settings: &mut MllmSettings) {
    settings.concurrency = 1;
    settings.attempts = 1;
    settings.breaker_failures = 3;
}

#[tokio::test]
async fn an_open_breaker_hands_the_job_to_the_fallback() {
    let mut bench = Bench::with(failing(1000), brittle).await;
    bench.fallback = Some(Arc::new(Reverse));
    bench.rebuild(|settings| settings.breaker_open_s = 3600);
    for _ in 0..2 {
        let refinement = bench.refine(5).await.unwrap();
        assert_eq!(ranks(&refinement), [5, 4, 3, 2, 1]);
        assert_eq!(refinement.ordered_by, Some(RefinerKind::Local));
        let why = refinement.degraded.unwrap();
        assert!(why.contains("`local` instead of `mllm`") && why.contains("suspended"), "{why}");
    }
    assert_eq!(bench.mock.describe_calls(), 3);
    assert!(bench.refiner.levels().suspended);
}

#[tokio::test]
async fn without_a_fallback_an_open_breaker_is_a_transient_error() {
    let bench = Bench::with(failing(1000), brittle).await;
    let error = bench.refine(5).await.unwrap_err();
    assert!(matches!(error, RefineError::Transient(_)), "{error}");
    let why = error.to_string();
    assert!(why.contains("suspended") && why.contains("500") && why.contains("down"), "{why}");
    let [server] = bench.refiner.servers().try_into().unwrap();
    assert!(server.suspended && server.suspended_for_s.is_some());
    let trouble = server.trouble.unwrap();
    assert_eq!((trouble.kind.as_str(), trouble.status), ("server_error", Some(500)));
}

#[tokio::test]
async fn a_server_that_refuses_every_call_is_asked_once_or_twice_and_then_no_more() {
    for (status, kind) in [(401, "key"), (402, "quota"), (404, "not_found"), (413, "too_large")] {
        let script = Script {
            describe: Box::new(move |_| Reply::Status(status, "the server's words".into())),
            ..Script::default()
        };
        let mut bench = Bench::new(script).await;
        bench.fallback = Some(Arc::new(Reverse));
        bench.rebuild(|settings| settings.breaker_open_s = 3600);
        for _ in 0..3 {
            let refinement = bench.refine(10).await.unwrap();
            let why = refinement.degraded.unwrap();
            assert!(why.contains("`local` instead of `mllm`"), "{why}");
            assert!(
                why.contains("the server's words") && why.contains(&status.to_string()),
                "{why}"
            );
        }
        assert!(bench.mock.describe_calls() <= 2, "{status}: {}", bench.mock.describe_calls());
        let [server] = bench.refiner.servers().try_into().unwrap();
        assert_eq!(server.trouble.unwrap().kind, kind);
    }
}

#[tokio::test]
async fn a_refused_job_is_deferred_if_it_is_to_wait() {
    let script = Script {
        describe: Box::new(|_| Reply::Status(401, "no such key".into())),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| {
        settings.breaker_open_s = 3600;
        settings.on_unavailable = OnUnavailable::Wait;
    })
    .await;
    let error = bench.refine(5).await.unwrap_err();
    let RefineError::Deferred { why, after } = error else { panic!("{error}") };
    assert!(why.contains("no such key") && after.as_secs() > 3500, "{why} {after:?}");
}

#[tokio::test]
async fn a_job_continues_when_the_breaker_closes() {
    let bench = Bench::with(failing(3), |settings| {
        brittle(settings);
        settings.breaker_open_s = 0;
        settings.on_unavailable = OnUnavailable::Wait;
    })
    .await;
    let refinement = bench.refine(6).await.unwrap();
    assert_eq!(bench.mock.describe_calls(), 6);
    assert!(refinement.degraded.unwrap().starts_with("3 of 6 pairs"));
    assert!(!bench.refiner.levels().suspended);
}

#[tokio::test]
async fn a_deferred_job_states_how_long_to_wait() {
    let bench = Bench::with(failing(1000), |settings| {
        brittle(settings);
        settings.breaker_open_s = 3600;
        settings.on_unavailable = OnUnavailable::Wait;
    })
    .await;
    let error = bench.refine(5).await.unwrap_err();
    let RefineError::Deferred { why, after } = error else { panic!("{error}") };
    assert!(why.contains("suspended"), "{why}");
    assert!((3590..=3600).contains(&after.as_secs()), "{after:?}");
}

#[tokio::test]
async fn spend_of_earlier_attempts_counts_against_the_budget_of_the_job() {
    let bench = Bench::with(Script::default(), |settings| settings.tokens_per_job = 20_000).await;
    let mut input = bench.input(2);
    input.spent.prompt_tokens = 19_990;
    let error = bench.refiner.refine(&input, &Steps::default()).await.unwrap_err();
    assert!(matches!(&error, RefineError::Permanent(why) if why.contains("tokens_per_job")));
    assert_eq!(bench.mock.describe_calls(), 0);
}

#[tokio::test]
async fn a_job_never_exceeds_its_budget() {
    let mut bench = Bench::with(Script::default(), |settings| {
        settings.concurrency = 1;
        settings.tokens_per_job = 6000;
    })
    .await;
    let refinement = bench.refine(20).await.unwrap();
    let usage = refinement.usage;
    assert!(usage.prompt_tokens + usage.completion_tokens <= 6000);
    assert!(refinement.degraded.unwrap().contains("the budget of the job is spent"));
    bench.fallback = Some(Arc::new(Reverse));
    bench.rebuild(|settings| settings.tokens_per_job = 10);
    let refinement = bench.refine(2).await.unwrap();
    assert_eq!(ranks(&refinement), [2, 1]);
    assert!(refinement.degraded.unwrap().contains("tokens_per_job"));
}

#[tokio::test]
async fn a_day_never_exceeds_its_budget() {
    let bench = Bench::with(Script::default(), |settings| {
        settings.price_prompt = 1.0;
        settings.price_completion = 2.0;
        settings.money_per_day = 1.0;
    })
    .await;
    let date = utc_day(Timestamp::now());
    let spent = |money| {
        let map = bench.shelf.map.name.clone();
        [DayUsage { date, map, usage: Usage::default(), money }]
    };
    bench.refiner.seed_spent_today(&spent(0.999));
    let error = bench.refine(2).await.unwrap_err();
    assert!(matches!(&error, RefineError::Transient(why) if why.contains("money_per_day")));
    assert_eq!(bench.mock.describe_calls(), 0);
    bench.refiner.seed_spent_today(&spent(0.5));
    assert_eq!(bench.refine(2).await.unwrap().degraded, None);
    assert!(bench.refiner.levels().spent_today.money > 0.5);
    let spent: f64 = bench.cache.spent.lock().iter().map(|spent| spent.money).sum();
    assert!((bench.refiner.levels().spent_today.money - 0.5 - spent).abs() < 1e-9);
}
