//! The refiner `mllm` of the real server against a mock of a multimodal LLM: how long a job takes, how many
//! jobs are refined in a time, what a job sends, and whether memory grows with the number of jobs.
//!
//! The peer of a job's time is the same job with one call at a time, as the reference code of the
//! paper makes them; both run here, the last figure is their ratio. The peer of many jobs is one job at a time
//! (`jobs.in_progress = 1`), which runs here as well.
//!
//! `cargo bench --bench mllm -- throughput` measures the times of jobs alone, and not sizes and memory.

#![allow(
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "it uses what the black-box tests use"
)]

use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabouts_testkit::mock_mllm::{MockMllm, Reply, Script};
use whereabouts_testkit::server::{Server, jpeg};
use whereabouts_town::{Town, TownSpec};

const CANDIDATES: usize = 10;
/// Typical length of the description of a pair.
const DESCRIPTION_CHARS: usize = 1600;

fn main() {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let together = job_seconds(CANDIDATES).await;
        let alone = job_seconds(1).await;
        println!(
            "a job of {CANDIDATES} candidates at 1 s a call: {together:.2} s; {alone:.2} s with one \
             call at a time: {:.1} × as long",
            alone / together
        );
        throughput().await;
        beside_one_that_hangs(together).await;
        if std::env::args().all(|argument| argument != "throughput") {
            sizes().await;
            memory().await;
        }
    });
}

/// Calls at once in the measurements of many jobs.
const AT_ONCE: usize = 100;

/// Many queued jobs: how long until the last has ended, with as many in progress as keep the calls busy, and one at a
/// time.
async fn throughput() {
    const JOBS: usize = 200;
    const JOBS_ONE_AT_A_TIME: usize = 10;
    let side_by_side = queue_seconds(JOBS, 100).await;
    let one_at_a_time = queue_seconds(JOBS_ONE_AT_A_TIME, 1).await;
    let bound = (JOBS * (CANDIDATES + 1)) as f64 / AT_ONCE as f64;
    println!(
        "{JOBS} jobs of {CANDIDATES} candidates at 1 s a call, {AT_ONCE} calls at once: {side_by_side:.1} s, {:.2} × \
         the bound of {bound:.0} s;\n    one job at a time, {JOBS_ONE_AT_A_TIME} jobs take {one_at_a_time:.1} s: {:.1} × \
         as long for each",
        side_by_side / bound,
        one_at_a_time / JOBS_ONE_AT_A_TIME as f64 * JOBS as f64 / side_by_side
    );
}

/// The time from the first call of a server whose queue is full of jobs to the end of the last of them.
async fn queue_seconds(jobs: usize, in_progress: usize) -> f64 {
    let dir = TempDir::new().unwrap();
    let (at_once, in_progress) = (AT_ONCE.to_string(), in_progress.to_string());
    let settings = [
        ("WHEREABOUTS_MLLM__CONCURRENCY", at_once.as_str()),
        ("WHEREABOUTS_JOBS__IN_PROGRESS", in_progress.as_str()),
    ];
    // Jobs queue up behind a model that never answers; at the shutdown all go back to the queue.
    let hanging =
        MockMllm::start(Script { describe: Box::new(|_| Reply::Hang), ..Script::default() }).await;
    let server = start(&dir, &hanging, &settings).await;
    let town = Town::new(TownSpec { places: jobs, ..TownSpec::default() });
    let mut hrefs = Vec::new();
    for place in 0..jobs {
        let frame = jpeg(&town.query(place, 0).image);
        let answer = server.post_jpeg("/localize?map=town", frame).await.expect(200);
        hrefs.push(answer["job"]["href"].as_str().unwrap().to_owned());
    }
    server.terminate();
    let first_call = Arc::new(OnceLock::new());
    let noted = Arc::clone(&first_call);
    let mock = MockMllm::start(Script {
        latency: Duration::from_secs(1),
        delay: Box::new(move |_| {
            noted.get_or_init(Timestamp::now);
            Duration::ZERO
        }),
        ..Script::default()
    })
    .await;
    let server = restart(&dir, &mock, &settings);
    let mut last = Timestamp::MIN;
    for href in hrefs {
        let job = ended(&server, &href).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        last = last.max(time(&job["finished_at"]));
    }
    assert_eq!(mock.describe_calls(), jobs * CANDIDATES);
    last.duration_since(*first_call.get().unwrap()).as_secs_f64()
}

/// Twenty jobs, one every fifth of a second; a pair of the first hangs for a minute.
async fn beside_one_that_hangs(alone: f64) {
    const JOBS: usize = 20;
    let dir = TempDir::new().unwrap();
    let mock = MockMllm::start(Script {
        latency: Duration::from_secs(1),
        describe: Box::new(|call| match call.number {
            5 => Reply::Hang,
            number => Reply::Text(format!("wall {number}")),
        }),
        ..Script::default()
    })
    .await;
    let at_once = AT_ONCE.to_string();
    let server = start(&dir, &mock, &[("WHEREABOUTS_MLLM__CONCURRENCY", &at_once)]).await;
    let town = Town::new(TownSpec { places: JOBS, ..TownSpec::default() });
    let frames: Vec<Vec<u8>> = (0..JOBS).map(|place| jpeg(&town.query(place, 0).image)).collect();
    let mut hrefs = Vec::new();
    let mut pace = tokio::time::interval(Duration::from_millis(200));
    for frame in frames {
        pace.tick().await;
        let answer = server.post_jpeg("/localize?map=town", frame).await.expect(200);
        hrefs.push(answer["job"]["href"].as_str().unwrap().to_owned());
    }
    let mut took = Vec::new();
    for href in &hrefs {
        let job = ended(&server, href).await;
        assert_eq!(job["state"], "succeeded", "{job}");
        let took_s = time(&job["finished_at"]).duration_since(time(&job["created_at"]));
        took.push(took_s.as_secs_f64());
    }
    let hung = took.iter().copied().fold(0.0, f64::max);
    took.retain(|seconds| *seconds < hung);
    let longest = took.iter().copied().fold(0.0, f64::max);
    println!(
        "{JOBS} jobs, one every 0.2 s, of which one waits {hung:.0} s for a pair that hangs: the slowest of the others \
         takes {longest:.2} s, {:.2} × as long as alone",
        longest / alone
    );
}

async fn one_second() -> MockMllm {
    MockMllm::start(Script { latency: Duration::from_secs(1), ..Script::default() }).await
}

fn time(value: &Value) -> Timestamp {
    value.as_str().unwrap().parse().unwrap()
}

/// Waits for a job that may wait long for its turn.
async fn ended(server: &Server, href: &str) -> Value {
    loop {
        let job = server.get(&format!("{href}?wait=60")).await.expect(200);
        if !job["finished_at"].is_null() {
            return job;
        }
    }
}

fn restart(dir: &TempDir, mock: &MockMllm, more: &[(&str, &str)]) -> Server {
    let url = mock.url();
    let settings = [
        ("WHEREABOUTS_REFINE__REFINER", "mllm"),
        ("WHEREABOUTS_MLLM__BASE_URL", url.as_str()),
        ("WHEREABOUTS_MLLM__REQUESTS_PER_MINUTE", "0"),
        ("WHEREABOUTS_MLLM__TOKENS_PER_DAY", "0"),
    ];
    Server::start(dir.path(), &[&settings[..], more].concat())
}

async fn start(dir: &TempDir, mock: &MockMllm, more: &[(&str, &str)]) -> Server {
    let server = restart(dir, mock, more);
    server.put("/maps/town", json!({"scene": "outdoor"})).await.expect(201);
    let town = town();
    for place in 0..CANDIDATES {
        let path = format!("/maps/town/images?id=place-{place}");
        server.post_jpeg(&path, jpeg(&town.reference(place).image)).await.expect(201);
    }
    server
}

fn town() -> Town {
    Town::new(TownSpec::default())
}

async fn refine(server: &Server, frame: Vec<u8>) -> Value {
    let answer = server.post_jpeg("/localize?map=town", frame).await.expect(200);
    let href = answer["job"]["href"].as_str().unwrap();
    let job = server.get(&format!("{href}?wait=60")).await.expect(200);
    assert_eq!(job["state"], "succeeded", "{job}");
    job
}

/// The time from the request to the end of its job.
async fn job_seconds(concurrency: usize) -> f64 {
    let dir = TempDir::new().unwrap();
    let mock = one_second().await;
    let concurrency = concurrency.to_string();
    let server = start(&dir, &mock, &[("WHEREABOUTS_MLLM__CONCURRENCY", &concurrency)]).await;
    let frame = jpeg(&town().query(3, 0).image);
    let began = Instant::now();
    refine(&server, frame).await;
    began.elapsed().as_secs_f64()
}

/// What one job sends, for frames of 640×480.
async fn sizes() {
    let dir = TempDir::new().unwrap();
    let mock = MockMllm::start(Script {
        describe: Box::new(|_| Reply::Text("wall ".repeat(DESCRIPTION_CHARS / 5))),
        // Without reported usage, the server uses its own estimate.
        counts_tokens: false,
        ..Script::default()
    })
    .await;
    let server = start(&dir, &mock, &[]).await;
    let job = refine(&server, jpeg(&town().query(3, 0).image)).await;
    let (describe, reason) = mock.request_bytes();
    let pair = &job["descriptions"][0]["usage"];
    let usage = &job["usage"];
    let tokens = |usage: &Value, of: &str| usage[of].as_u64().unwrap();
    println!(
        "a job of {CANDIDATES} pairs of 640×480, descriptions of {DESCRIPTION_CHARS} characters:\n    \
         {CANDIDATES} describe requests, {:.0} kB and {} tokens each; one reason request, {:.0} kB \
         and {} tokens;\n    {} tokens sent and {} received in all (estimated as OpenAI counts)",
        describe as f64 / CANDIDATES as f64 / 1e3,
        tokens(pair, "prompt_tokens"),
        reason as f64 / 1e3,
        tokens(usage, "prompt_tokens") - CANDIDATES as u64 * tokens(pair, "prompt_tokens"),
        tokens(usage, "prompt_tokens"),
        tokens(usage, "completion_tokens"),
    );
}

/// Resident memory while 2,000 jobs run, each of 10 pairs. Every fifth frame is new.
async fn memory() {
    const JOBS: usize = 2000;
    let dir = TempDir::new().unwrap();
    let mock = MockMllm::start(Script {
        describe: Box::new(|_| Reply::Text("wall ".repeat(DESCRIPTION_CHARS / 5))),
        ..Script::default()
    })
    .await;
    // The caches fill up early, so that only a leak grows.
    let small = [
        ("WHEREABOUTS_DATA__DB_CACHE_BYTES", "8388608"),
        ("WHEREABOUTS_REFINE__DENSE_CACHE_BYTES", "8388608"),
    ];
    let server = start(&dir, &mock, &small).await;
    let town = Town::new(TownSpec {
        places: 1000,
        width: 320,
        height: 240,
        seed: 3,
        ..TownSpec::default()
    });
    let began = Instant::now();
    let mut resident = Vec::new();
    for number in 0..JOBS {
        let (place, variant) = (number / 5, 0);
        refine(&server, jpeg(&town.query(place, variant).image)).await;
        if (number + 1) % 250 == 0 {
            resident.push(server.resident_bytes() >> 20);
        }
    }
    println!(
        "{JOBS} jobs in {:.0} s; resident memory after each 250, in MiB: {resident:?}",
        began.elapsed().as_secs_f64()
    );
}
