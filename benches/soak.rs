//! Soak test of the real server under mixed traffic: frames with jobs, images that are added and removed, jobs
//! that are looked up. Prints a table of memory, open files, bytes on disk and latency over the time, and ends
//! with exit code 1 if something grows that should not.
//!
//! `make soak`, or `cargo bench --bench soak -- MINUTES`

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use bytes::Bytes;
use tokio::sync::Mutex;
use tokio::task::JoinSet;
use whereabouts_testkit::server::Server;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;

const MINUTES: f64 = 10.0;
const PLACES: usize = 60;
/// Rows of the table.
const ROWS: usize = 20;
/// Number of ended jobs that are kept, small enough to be reached.
const KEPT_JOBS: &str = "200";

/// Limits of the growth from the second quarter of the time to the last.
const MEMORY_GROWTH: f64 = 1.15;
const FILES_GROWTH: usize = 16;
const DISK_GROWTH: f64 = 1.5;
const LATENCY_GROWTH: f64 = 2.0;

/// Measurements at one moment.
#[derive(Debug, Clone, Copy)]
struct Sample {
    at: Duration,
    resident: u64,
    files: usize,
    disk: u64,
    requests: usize,
    p50: Duration,
    p95: Duration,
}

/// Records of the clients.
#[derive(Default)]
struct Notes {
    latencies: Mutex<Vec<Duration>>,
    requests: AtomicUsize,
    refused: AtomicUsize,
    failed: AtomicUsize,
    ended: AtomicBool,
}

fn main() -> anyhow::Result<ExitCode> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let asked = std::env::args().skip(1).find_map(|argument| argument.parse().ok());
    let length = Duration::from_secs_f64(60.0 * asked.unwrap_or(MINUTES));
    let town =
        Town::new(TownSpec { places: PLACES, width: 320, height: 240, ..TownSpec::default() });
    let encoded = |pixels: &image::RgbImage| encode_jpeg(pixels).map(Bytes::from);
    let images = (0..PLACES).map(|place| encoded(&town.reference(place).image));
    let images: Arc<Vec<Bytes>> = Arc::new(images.collect::<Result<_, _>>()?);
    let frames = (0..PLACES).map(|place| encoded(&town.query(place, 0).image));
    let frames: Arc<Vec<Bytes>> = Arc::new(frames.collect::<Result<_, _>>()?);
    let data = tempfile::tempdir()?;
    let settings =
        [("WHEREABOUTS_JOBS__KEEP_COUNT", KEPT_JOBS), ("WHEREABOUTS_JOBS__SWEEP_S", "2")];
    let server = Server::start_for_benchmark("xfeat", data.path(), &settings);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let kept = runtime.block_on(soak(&server, data.path(), &images, &frames, length))?;
    Ok(if kept { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

async fn soak(
    server: &Server,
    data: &Path,
    images: &Arc<Vec<Bytes>>,
    frames: &Arc<Vec<Bytes>>,
    length: Duration,
) -> anyhow::Result<bool> {
    let http = server.http.clone();
    let url = server.url.clone();
    let put = http.put(format!("{url}/maps/soak")).json(&serde_json::json!({}));
    put.send().await?.error_for_status()?;
    for (place, image) in images.iter().enumerate().take(PLACES / 2) {
        send_image(&http, &url, place, image).await?.error_for_status()?;
    }
    let notes = Arc::new(Notes::default());
    let mut clients = JoinSet::new();
    for robot in 0..3 {
        clients.spawn(robots(
            http.clone(),
            url.clone(),
            Arc::clone(frames),
            robot,
            Arc::clone(&notes),
        ));
    }
    clients.spawn(mappers(http, url, Arc::clone(images), Arc::clone(&notes)));
    println!(
        "{:>8} {:>9} {:>6} {:>9} {:>9} {:>8} {:>8}",
        "time", "RSS MB", "files", "disk MB", "requests", "p50 ms", "p95 ms"
    );
    let start = Instant::now();
    let mut samples = Vec::new();
    for row in 1..=ROWS {
        tokio::time::sleep_until((start + length.mul_f64(row as f64 / ROWS as f64)).into()).await;
        let sample = look(server, data, start.elapsed(), &notes).await?;
        println!(
            "{:>7.0}s {:>9.1} {:>6} {:>9.1} {:>9} {:>8.1} {:>8.1}",
            sample.at.as_secs_f64(),
            sample.resident as f64 / 1e6,
            sample.files,
            sample.disk as f64 / 1e6,
            sample.requests,
            sample.p50.as_secs_f64() * 1e3,
            sample.p95.as_secs_f64() * 1e3
        );
        samples.push(sample);
    }
    notes.ended.store(true, Ordering::Relaxed);
    while clients.join_next().await.is_some() {}
    Ok(judge(&samples, &notes))
}

/// Posts frames, and looks up every fifth job.
async fn robots(
    http: reqwest::Client,
    url: String,
    frames: Arc<Vec<Bytes>>,
    robot: usize,
    notes: Arc<Notes>,
) {
    let mut number = robot;
    while !notes.ended.load(Ordering::Relaxed) {
        number += 7;
        let request = http
            .post(format!("{url}/localize?map=soak"))
            .header("content-type", "image/jpeg")
            .body(frames[number % frames.len()].clone());
        let start = Instant::now();
        let answer = notes.count(request.send().await).await;
        let Some(answer) = answer else { continue };
        notes.latencies.lock().await.push(start.elapsed());
        if number.is_multiple_of(5)
            && let Some(href) = answer["job"]["href"].as_str()
        {
            notes.count(http.get(format!("{url}{href}?wait=5")).send().await).await;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// Adds and removes images in turn.
async fn mappers(http: reqwest::Client, url: String, images: Arc<Vec<Bytes>>, notes: Arc<Notes>) {
    let mut place = PLACES / 2;
    while !notes.ended.load(Ordering::Relaxed) {
        let sent = send_image(&http, &url, place, &images[place]).await;
        notes.count(sent).await;
        let removed = http.delete(format!("{url}/maps/soak/images/{place}")).send().await;
        notes.count(removed).await;
        place = PLACES / 2 + (place + 1) % (PLACES / 2);
        tokio::time::sleep(Duration::from_millis(250)).await;
    }
}

async fn send_image(
    http: &reqwest::Client,
    url: &str,
    place: usize,
    image: &Bytes,
) -> reqwest::Result<reqwest::Response> {
    http.post(format!("{url}/maps/soak/images?id={place}"))
        .header("content-type", "image/jpeg")
        .body(image.clone())
        .send()
        .await
}

impl Notes {
    /// Counts a response; returns its JSON if it was successful.
    async fn count(&self, answer: reqwest::Result<reqwest::Response>) -> Option<serde_json::Value> {
        self.requests.fetch_add(1, Ordering::Relaxed);
        match answer {
            Ok(answer) if answer.status().is_success() => {
                Some(answer.json().await.unwrap_or_default())
            }
            Ok(answer) if answer.status() == reqwest::StatusCode::TOO_MANY_REQUESTS => {
                self.refused.fetch_add(1, Ordering::Relaxed);
                None
            }
            Ok(_) | Err(_) => {
                self.failed.fetch_add(1, Ordering::Relaxed);
                None
            }
        }
    }
}

async fn look(server: &Server, data: &Path, at: Duration, notes: &Notes) -> anyhow::Result<Sample> {
    let process = format!("/proc/{}", server.id());
    let status = std::fs::read_to_string(format!("{process}/status"))?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).context("no VmRSS")?;
    let kilobytes: u64 = line.split_whitespace().nth(1).context("no VmRSS")?.parse()?;
    let mut latencies = std::mem::take(&mut *notes.latencies.lock().await);
    latencies.sort_unstable();
    let quantile = |share: f64| {
        let place = (share * latencies.len().saturating_sub(1) as f64).round() as usize;
        latencies.get(place).copied().unwrap_or_default()
    };
    Ok(Sample {
        at,
        resident: kilobytes * 1024,
        files: std::fs::read_dir(format!("{process}/fd"))?.count(),
        disk: bytes_of(data),
        requests: notes.requests.load(Ordering::Relaxed),
        p50: quantile(0.5),
        p95: quantile(0.95),
    })
}

/// Bytes that the files of a folder take on the disk; some are sparse.
fn bytes_of(folder: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    let entries = walkdir::WalkDir::new(folder).into_iter().flatten();
    // Files may be removed while they are listed.
    entries.filter_map(|entry| Some(entry.metadata().ok()?.blocks() * 512)).sum()
}

fn judge(samples: &[Sample], notes: &Notes) -> bool {
    let quarter = samples.len() / 4;
    let (early, late) = (&samples[quarter..2 * quarter], &samples[3 * quarter..]);
    let most = |part: &[Sample], of: fn(&Sample) -> f64| part.iter().map(of).fold(0.0, f64::max);
    let grown = |of: fn(&Sample) -> f64| most(late, of) / most(early, of).max(f64::MIN_POSITIVE);
    let memory = grown(|sample| sample.resident as f64);
    let disk = grown(|sample| sample.disk as f64);
    let latency = grown(|sample| sample.p50.as_secs_f64());
    let files =
        most(late, |sample| sample.files as f64) - most(early, |sample| sample.files as f64);
    let failed = notes.failed.load(Ordering::Relaxed);
    println!("{} requests were refused", notes.refused.load(Ordering::Relaxed));
    [
        check(failed == 0, format!("{failed} requests failed")),
        check(memory <= MEMORY_GROWTH, format!("memory: {memory:.2} ×, at most {MEMORY_GROWTH}")),
        check(
            files <= FILES_GROWTH as f64,
            format!("open files: {files:+}, at most +{FILES_GROWTH}"),
        ),
        check(disk <= DISK_GROWTH, format!("disk: {disk:.2} ×, at most {DISK_GROWTH}")),
        check(
            latency <= LATENCY_GROWTH,
            format!("median latency: {latency:.2} ×, at most {LATENCY_GROWTH}"),
        ),
    ]
    .into_iter()
    .all(|kept| kept)
}

fn check(kept: bool, what: String) -> bool {
    println!("{} {what}", if kept { "pass" } else { "FAIL" });
    kept
}
