//! Servers that bear only so much, over real sockets.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use futures_util::future::join_all;
use jiff::fmt::rfc2822::DateTimePrinter;
use jiff::{SignedDuration, Timestamp};
use whereabouts_testkit::front::{Front, Treatment};
use whereabouts_testkit::mock_mllm::{Load, Purpose};

use super::*;
use whereabouts_core::Digest;

const LATENCY: Duration = Duration::from_millis(30);

/// A server that answers after [`LATENCY`] and turns calls away as told.
fn script(turn_away: impl Fn(&Load) -> Option<Reply> + Send + Sync + 'static) -> Script {
    Script { latency: LATENCY, turn_away: Box::new(turn_away), ..Script::default() }
}

/// A server that works on so many calls at once.
fn bears(at_once: usize, reply: Reply) -> Script {
    script(move |load| (load.in_flight > at_once).then(|| reply.clone()))
}

impl Bench {
    /// Refines jobs side by side, each of another frame, and returns what became of them and how long they took.
    async fn refine_all(&self, jobs: usize, candidates: usize) -> (Vec<Refinement>, Duration) {
        let began = Instant::now();
        let refined = (0..jobs).map(|job| async move {
            let mut input = self.input(candidates);
            input.frame.digest = self.frame(job);
            self.refiner.refine(&input, &Steps::default()).await.unwrap()
        });
        (join_all(refined).await, began.elapsed())
    }

    /// The pictures after the first twelve are frames.
    fn frame(&self, job: usize) -> Digest {
        self.shelf.digest(12 + job % 12)
    }

    fn limit(&self) -> usize {
        self.refiner.levels().calls_at_once
    }
}

fn all_good(refinements: &[Refinement]) {
    for refinement in refinements {
        assert_eq!(refinement.degraded, None);
    }
}

fn raw(status: u16, headers: &[(&str, &str)], body: &str) -> Reply {
    let headers = headers.iter().map(|(name, value)| ((*name).into(), (*value).into())).collect();
    Reply::Raw { status, headers, body: body.into() }
}

/// What servers and proxies say when they have too much to do, and where that was reported.
fn refusals() -> Vec<(&'static str, Reply)> {
    let soon = Timestamp::now().saturating_add(SignedDuration::from_secs(1)).unwrap();
    let soon = DateTimePrinter::new().timestamp_to_rfc9110_string(&soon).unwrap();
    vec![
        (
            "429 with the API's own words",
            raw(429, &[], r#"{"error": {"message": "Rate limit reached"}}"#),
        ),
        (
            "429 with HTML of a proxy: https://github.com/ayaka14732/ChatGPTAPIFree/issues/27",
            raw(
                429,
                &[("content-type", "text/html")],
                "<!doctype html><title>429</title>429 Too Many Requests",
            ),
        ),
        (
            "429 without a body: https://github.com/closeio/closeio-api/issues/120",
            raw(429, &[], ""),
        ),
        (
            "429 with `detail`: https://github.com/acheong08/ChatGPT/pull/885",
            raw(429, &[], r#"{"detail": "Too many requests. Try again later."}"#),
        ),
        (
            "429 with a string for an error: https://github.com/acheong08/ChatGPT/issues/1173",
            raw(429, &[], r#"{"error": "Rate limited by proxy server"}"#),
        ),
        ("429 with Retry-After: 0", Reply::Busy("0".into())),
        ("429 with retry-after-ms", raw(429, &[("retry-after-ms", "40")], "{}")),
        ("429 with a Retry-After that is none", Reply::Busy("soon".into())),
        (
            "503 with Retry-After as a date: https://github.com/supabase/supabase-js/pull/2634",
            raw(503, &[("retry-after", &soon)], "upstream overloaded"),
        ),
        (
            "503 of uvicorn's limit_concurrency: https://github.com/abetlen/llama-cpp-python/pull/868",
            raw(503, &[("content-type", "text/plain")], "Service Unavailable"),
        ),
        (
            "503 of Ollama's cloud: https://github.com/ollama/ollama/issues/15934",
            raw(503, &[], r#"{"error":"Server overloaded, please retry shortly (ref: 06d8)"}"#),
        ),
        (
            "503 of Ollama's queue: https://github.com/IBM/prompt-declaration-language/issues/702",
            raw(
                503,
                &[],
                r#"{"error":"server busy, please try again.  maximum pending requests exceeded"}"#,
            ),
        ),
        (
            "500 of Ollama's queue: https://github.com/ollama/ollama/issues/4124",
            raw(
                500,
                &[],
                r#"{"error":"server busy, please try again.  maximum pending requests exceeded"}"#,
            ),
        ),
        (
            "500 of a runner without a free slot: https://github.com/ollama/ollama/issues/4159",
            raw(500, &[], r#"{"error":"unexpected server status: llm busy - no slots available"}"#),
        ),
        (
            "529 of Anthropic",
            raw(
                529,
                &[],
                r#"{"type":"error","error":{"type":"overloaded_error","message":"Overloaded"}}"#,
            ),
        ),
        (
            "an error of a rate limit inside of a 200",
            raw(200, &[], r#"{"error": {"message": "Rate limit exceeded", "code": 429}}"#),
        ),
    ]
}

#[tokio::test]
async fn whatever_a_server_says_when_it_has_too_much_to_do_no_pair_is_lost() {
    for (name, refusal) in refusals() {
        let bench = Bench::new(bears(3, refusal)).await;
        let (refined, took) = bench.refine_all(3, 6).await;
        refined.iter().for_each(|refinement| assert_eq!(refinement.degraded, None, "{name}"));
        assert_eq!(bench.mock.asked_again(), 0, "{name}");
        assert!(bench.mock.turned_away() >= 2, "{name}");
        assert!((1..=8).contains(&bench.limit()), "{name}: {}", bench.limit());
        let [server] = bench.refiner.servers().try_into().unwrap();
        assert!(!server.suspended && server.trouble.is_none(), "{name}: {:?}", server.trouble);
        assert!(took < Duration::from_secs(10), "{name}: {took:?}");
    }
}

#[tokio::test]
async fn the_limit_follows_a_server_that_bears_fewer_and_then_more() {
    let at_once = Arc::new(AtomicUsize::new(12));
    let bearing = Arc::clone(&at_once);
    let script = script(move |load| {
        let bears = bearing.load(Ordering::Relaxed);
        (load.in_flight > bears).then(|| Reply::Status(429, "too many".into()))
    });
    let mut bench = Bench::new(script).await;
    all_good(&bench.refine_all(6, 10).await.0);
    assert!((3..=20).contains(&bench.limit()), "{}", bench.limit());
    at_once.store(2, Ordering::Relaxed);
    bench.shelf.map.scene = Scene::Indoor;
    all_good(&bench.refine_all(6, 10).await.0);
    assert!(bench.limit() <= 6, "{}", bench.limit());
    at_once.store(1000, Ordering::Relaxed);
    for jobs in 7..13 {
        bench.refine_all(jobs, 12).await;
    }
    assert!(bench.limit() > 8, "{}", bench.limit());
}

#[tokio::test]
async fn a_server_that_is_slow_when_loaded_gets_fewer_calls_at_once() {
    // Four at a time, and each further one makes all of them slower.
    let script = Script {
        latency: LATENCY,
        delay: Box::new(|load| LATENCY.mul_f64((load.in_flight as f64 / 4.0 - 1.0).max(0.0))),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| settings.concurrency = 60).await;
    // A job by itself first, so that the usual time is known.
    bench.refine_all(1, 4).await;
    for _ in 0..4 {
        bench.refine_all(12, 12).await;
        bench.cache.forget();
    }
    assert!(bench.limit() < 40, "{}", bench.limit());
}

#[tokio::test]
async fn rare_spurious_refusals_leave_the_limit_where_it_is() {
    let script = script(|load| (load.number % 50 == 25).then(|| Reply::Status(429, String::new())));
    let bench = Bench::new(script).await;
    all_good(&bench.refine_all(12, 12).await.0);
    assert!(bench.mock.turned_away() >= 3);
    assert_eq!(bench.limit(), 32);
}

#[tokio::test]
async fn a_server_that_turns_everything_away_suspends_calls_as_one_that_fails() {
    let mut bench = Bench::new(script(|_| Some(Reply::Status(429, "never".into())))).await;
    bench.fallback = Some(Arc::new(limits::Reverse));
    bench.rebuild(|settings| settings.breaker_open_s = 3600);
    let (refined, _) = bench.refine_all(6, 10).await;
    for refinement in &refined {
        let why = refinement.degraded.clone().unwrap();
        assert!(why.contains("`local` instead of `mllm`") && why.contains("never"), "{why}");
    }
    assert!(
        bench.mock.arrived(Purpose::Describe) < 80,
        "{}",
        bench.mock.arrived(Purpose::Describe)
    );
    assert!(bench.refiner.levels().suspended);
}

#[tokio::test]
async fn a_call_that_hangs_delays_its_own_job_only() {
    let script = Script {
        latency: LATENCY,
        describe: Box::new(|call| match call.number {
            3 => Reply::Hang,
            number => Reply::Text(format!("notes number {number}.")),
        }),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| settings.attempts = 1).await;
    let ended = AtomicUsize::new(0);
    let jobs = (0..12).map(|job| {
        let (bench, ended) = (&bench, &ended);
        async move {
            let mut input = bench.input(10);
            input.frame.digest = bench.frame(job);
            bench.refiner.refine(&input, &Steps::default()).await.unwrap();
            ended.fetch_add(1, Ordering::Relaxed);
        }
    });
    let eleven = async {
        while ended.load(Ordering::Relaxed) < 11 {
            tokio::task::yield_now().await;
        }
    };
    tokio::select! {
        _ = join_all(jobs) => panic!("the job whose call hangs has ended"),
        () = eleven => {}
    }
}

#[tokio::test]
async fn the_time_in_our_queue_is_no_part_of_a_calls_timeout() {
    let script = Script { latency: Duration::from_millis(300), ..Script::default() };
    // Ten calls one after another take three times as long as one may.
    let bench = Bench::with(script, |settings| {
        settings.concurrency = 1;
        settings.timeout_s = 1;
    })
    .await;
    let refinement = bench.refine(10).await.unwrap();
    assert_eq!((refinement.degraded, bench.mock.describe_calls()), (None, 10));
}

#[tokio::test]
async fn the_calls_of_the_older_job_go_first() {
    let order = Arc::new(parking_lot::Mutex::new(Vec::new()));
    let noted = Arc::clone(&order);
    let script = Script {
        latency: Duration::from_millis(10),
        describe: Box::new(move |call| {
            noted.lock().push(call.pair.0.clone());
            Reply::Text("notes".into())
        }),
        ..Script::default()
    };
    let bench = Bench::with(script, |settings| settings.concurrency = 1).await;
    // The younger job begins first.
    let (mut older, mut younger) = (bench.input(6), bench.input(6));
    older.frame.digest = bench.frame(1);
    younger.frame.digest = bench.frame(2);
    assert!(older.id < younger.id);
    let (steps, more) = (Steps::default(), Steps::default());
    let young = bench.refiner.refine(&younger, &steps);
    let old = bench.refiner.refine(&older, &more);
    let (young, old) = tokio::join!(young, old);
    all_good(&[young.unwrap(), old.unwrap()]);
    let order = order.lock();
    let turns = order.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!(turns <= 2, "the calls of the older job were interrupted: {order:?}");
}

#[tokio::test]
async fn connections_that_an_overloaded_host_resets_lose_no_pair() {
    // https://github.com/ggml-org/llama.cpp/issues/11411 and https://github.com/vllm-project/vllm/issues/2060
    for reset in [Treatment::Reset, Treatment::ResetAfterRequest] {
        let mut bench = Bench::new(script(|_| None)).await;
        let treat = move |open| if open > 4 { reset } else { Treatment::Pass };
        let front = Front::start(&bench.mock.url(), treat).await;
        bench.rebuild(|settings| settings.base_url = front.url());
        all_good(&bench.refine_all(4, 8).await.0);
        assert!(front.resets() >= 2, "{}", front.resets());
        assert_eq!(bench.mock.asked_again(), 0);
        assert!(!bench.refiner.levels().suspended);
        assert!(bench.limit() <= 12, "{}", bench.limit());
    }
}

#[tokio::test]
async fn a_head_that_trickles_is_waited_for_within_the_timeout_and_no_longer() {
    let mut bench = Bench::new(script(|_| None)).await;
    let slow = |pause: u64| move |_| Treatment::SlowHead(Duration::from_millis(pause));
    let front = Front::start(&bench.mock.url(), slow(5)).await;
    bench.rebuild(|settings| {
        settings.base_url = front.url();
        settings.timeout_s = 1;
        settings.attempts = 1;
    });
    all_good(&[bench.refine(3).await.unwrap()]);
    let front = Front::start(&bench.mock.url(), slow(500)).await;
    bench.cache.forget();
    bench.rebuild(|settings| settings.base_url = front.url());
    let error = bench.refine(3).await.unwrap_err();
    assert!(error.to_string().contains("mllm.timeout_s"), "{error}");
}
