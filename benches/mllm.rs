//! The refiner `mllm` of the real server against a mock of a multimodal LLM: how long a job takes,
//! what it sends, and whether memory grows with the number of jobs.
//!
//! The peer of a job's time is the same job with one call at a time, as the reference code of the
//! paper makes them; both run here, the last figure is their ratio.

#![allow(
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "it uses what the black-box tests use"
)]

use std::time::{Duration, Instant};

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
        sizes().await;
        memory().await;
    });
}

async fn start(dir: &TempDir, mock: &MockMllm, more: &[(&str, &str)]) -> Server {
    let url = mock.url();
    let settings = [
        ("WHEREABOUTS_REFINE__REFINER", "mllm"),
        ("WHEREABOUTS_MLLM__BASE_URL", url.as_str()),
        ("WHEREABOUTS_MLLM__REQUESTS_PER_MINUTE", "0"),
        ("WHEREABOUTS_MLLM__TOKENS_PER_DAY", "0"),
    ];
    let server = Server::start(dir.path(), &[&settings[..], more].concat());
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
    let mock =
        MockMllm::start(Script { latency: Duration::from_secs(1), ..Script::default() }).await;
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
    let town = Town::new(TownSpec { places: 1000, width: 320, height: 240, seed: 3 });
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
