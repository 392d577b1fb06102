//! `/localize` of the real server, against bare extraction in one process.
//!
//! The peer is what no server can undercut: the same frames decoded and run through the same model
//! in this process, one at a time, without HTTP, search or store. Both run in turn, in the same
//! run, and the last lines are ratios.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use serde_json::Value;
use whereabouts::demo::{Town, TownSpec};
use whereabouts::domain::DescriptorKind;
use whereabouts::retrieve::decode::encode_jpeg;
use whereabouts::retrieve::{Assets, Extractor, ExtractorSettings, ImageLimits, Wanted};

const PLACES: usize = 200;
const FRAMES: usize = 50;
const REQUESTS: usize = 400;

fn main() -> anyhow::Result<()> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let spec = TownSpec { places: PLACES, ..TownSpec::default() };
    let town = Town::new(spec);
    let frames: Vec<bytes::Bytes> = (0..FRAMES)
        .map(|place| Ok(encode_jpeg(&town.query(place, 0).image)?.into()))
        .collect::<anyhow::Result<_>>()?;
    let bare = bare_extraction(&frames)?;
    println!("bare extraction, one at a time   {bare}");

    let data = tempfile::tempdir()?;
    let server = Server::start(data.path())?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        server.index(&town).await?;
        for refine in ["off", "async"] {
            for clients in [1, 8] {
                let load = server.load(&frames, clients, refine).await?;
                println!("{clients} clients, refine={refine:<6} {load}");
                println!(
                    "    median is {:.2} × bare extraction; inference is {:.0} % of the answer; \
                     throughput is {:.2} × bare",
                    load.times.median_ms / bare.median_ms,
                    load.inference_share * 100.0,
                    load.times.per_second / bare.per_second
                );
            }
        }
        Ok(())
    })
}

/// Decode, resize, inference and pooling, one frame after another.
fn bare_extraction(frames: &[bytes::Bytes]) -> anyhow::Result<Times> {
    // By whoever is fastest on this machine, as the server does.
    let settings = ExtractorSettings {
        wanted: Wanted::default(),
        ..ExtractorSettings::plain(
            "xfeat",
            std::thread::available_parallelism()?.get(),
            ImageLimits { max_pixels: 50_000_000 },
        )
    };
    let extractor = Extractor::load(&Assets::locate(None), &settings)?;
    let start = Instant::now();
    let times = (0..REQUESTS).map(|i| {
        let start = Instant::now();
        extractor.extract(&frames[i % frames.len()], DescriptorKind::Gem)?;
        Ok(start.elapsed())
    });
    let times = times.collect::<anyhow::Result<Vec<_>>>()?;
    Ok(Times::new(times, start.elapsed()))
}

struct Times {
    median_ms: f64,
    p99_ms: f64,
    per_second: f64,
}

impl Times {
    fn new(mut times: Vec<Duration>, took: Duration) -> Self {
        times.sort();
        let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize];
        Self {
            median_ms: at(0.5).as_secs_f64() * 1e3,
            p99_ms: at(0.99).as_secs_f64() * 1e3,
            per_second: times.len() as f64 / took.as_secs_f64(),
        }
    }
}

impl std::fmt::Display for Times {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "p50 {:6.1} ms  p99 {:6.1} ms  {:6.1} frames/s",
            self.median_ms, self.p99_ms, self.per_second
        )
    }
}

struct Load {
    times: Times,
    /// The part of the whole time that the server spent in inference, on average.
    inference_share: f64,
}

impl std::fmt::Display for Load {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.times.fmt(f)
    }
}

struct Server {
    child: Child,
    url: String,
    http: reqwest::Client,
}

impl Server {
    fn start(data: &std::path::Path) -> anyhow::Result<Self> {
        let address_file = data.join("address");
        let mut child = Command::new(env!("CARGO_BIN_EXE_whereabouts"))
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(data.join("data"))
            .arg("--address-file")
            .arg(&address_file)
            .env("WHEREABOUTS_LOG__FORMAT", "json")
            .stderr(Stdio::piped())
            .spawn()?;
        let mut log = BufReader::new(child.stderr.take().context("no log")?).lines();
        while !log.next().context("the server ended")??.contains("\"ready\"") {}
        std::thread::spawn(move || log.for_each(drop));
        let address = std::fs::read_to_string(address_file)?;
        Ok(Self { child, url: format!("http://{}", address.trim()), http: reqwest::Client::new() })
    }

    async fn index(&self, town: &Town) -> anyhow::Result<()> {
        let map = self.http.put(format!("{}/maps/town", self.url)).body("{}");
        map.send().await?.error_for_status()?;
        let start = Instant::now();
        for place in 0..town.places() {
            let picture = encode_jpeg(&town.reference(place).image)?;
            let url = format!("{}/maps/town/images?id={place}", self.url);
            let request = self.http.post(url).header("content-type", "image/jpeg").body(picture);
            request.send().await?.error_for_status()?;
        }
        let took = start.elapsed().as_secs_f64();
        println!("indexed {PLACES} images in {took:.1} s, drawing included, one client");
        Ok(())
    }

    async fn load(
        &self,
        frames: &[bytes::Bytes],
        clients: usize,
        refine: &'static str,
    ) -> anyhow::Result<Load> {
        let next = Arc::new(AtomicUsize::new(0));
        let start = Instant::now();
        let mut running = tokio::task::JoinSet::new();
        for _ in 0..clients {
            let (next, http, frames) = (Arc::clone(&next), self.http.clone(), frames.to_vec());
            let url = format!("{}/localize?map=town&refine={refine}", self.url);
            running.spawn(async move {
                let mut answered = Vec::new();
                loop {
                    let i = next.fetch_add(1, Ordering::Relaxed);
                    if i >= REQUESTS {
                        return anyhow::Ok(answered);
                    }
                    let frame = frames[i % frames.len()].clone();
                    let start = Instant::now();
                    let request = http.post(&url).header("content-type", "image/jpeg").body(frame);
                    let answer: Value = request.send().await?.error_for_status()?.json().await?;
                    let timing = &answer["timing_ms"];
                    let share = timing["extract"].as_f64().unwrap_or(0.0)
                        / timing["total"].as_f64().unwrap_or(1.0);
                    answered.push((start.elapsed(), share));
                }
            });
        }
        let mut answered = Vec::new();
        while let Some(client) = running.join_next().await {
            answered.extend(client??);
        }
        let took = start.elapsed();
        let inference_share =
            answered.iter().map(|(_, share)| share).sum::<f64>() / answered.len() as f64;
        let times = answered.into_iter().map(|(time, _)| time).collect();
        Ok(Load { times: Times::new(times, took), inference_share })
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
