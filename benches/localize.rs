//! `/localize` of the real server against a lower bound: the same frames through the same model in this process,
//! without HTTP, search or store, once one frame after another, and once as a batch job that keeps inference busy.
//! All are measured in turn in the same run, and the lines end with ratios.
//!
//! `cargo bench --bench localize -- MODEL` takes another model than xfeat; WHEREABOUTS_MODEL__ASSETS
//! says where it is, if it is not among the checkout's assets.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use futures_util::{TryStreamExt, stream};
use serde_json::Value;
use whereabouts_core::DescriptorKind;
use whereabouts_server::config::{Config, Overrides};
use whereabouts_testkit::server::Server;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;
use whereabouts_vision::{
    Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits, ProviderPreference,
};

const PLACES: usize = 200;
const FRAMES: usize = 50;
const REQUESTS: usize = 400;

fn main() -> anyhow::Result<()> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let given = std::env::args().skip(1).find(|argument| !argument.starts_with('-'));
    let model = given.unwrap_or_else(|| "xfeat".into());
    let spec = TownSpec { places: PLACES, ..TownSpec::default() };
    let town = Town::new(spec);
    let frames: Vec<bytes::Bytes> = (0..FRAMES)
        .map(|place| Ok(encode_jpeg(&town.query(place, 0).image)?.into()))
        .collect::<anyhow::Result<_>>()?;
    let (bare, batch) = in_process(&model, &frames)?;
    println!("in this process, one frame after another   {bare}");
    println!("in this process, as a batch job            {:31}{batch:6.1} frames/s", "");

    let data = tempfile::tempdir()?;
    let server = Server::start_for_benchmark(&model, data.path(), &[]);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        index(&server, &town, batch).await?;
        for refine in ["off", "async"] {
            for clients in [1, 16] {
                let load = load(&server, &frames, clients, refine).await?;
                println!("{clients:2} clients, refine={refine:<6}                  {load}");
                println!(
                    "    p50 {:.2} × one frame in this process; {:.2} × the batch job's frames a \
                     second; inference and waiting for it are {:.0} % of the answer",
                    load.times.median_ms / bare.median_ms,
                    load.times.per_second / batch,
                    load.inference_share * 100.0,
                );
            }
        }
        Ok(())
    })
}

/// Decode, resize, inference and pooling: one frame after another, and the frames a second of a batch
/// job.
fn in_process(model: &str, frames: &[bytes::Bytes]) -> anyhow::Result<(Times, f64)> {
    let config = Config::load(None, &Overrides::default())?;
    let threads = std::thread::available_parallelism()?.get();
    // With the fastest provider on this machine, like the server.
    let settings = ExtractorSettings {
        preference: ProviderPreference::default(),
        layout: config.model.layout(),
        exact_decode: config.image.exact,
        ..ExtractorSettings::plain(model, threads, ImageLimits { max_pixels: 50_000_000 })
    };
    let extractor = Extractor::load(&Assets::locate(config.model.assets()), &settings)?;
    for (kind, times) in kinds_in_turn(&extractor, frames)? {
        println!("in this process, kinds in turn: {kind:<9}  {times}");
    }
    let kind = extractor.manifest().default_kind();
    let extract = |frame: &[u8]| extractor.extract(frame, kind, FeatureSet::DescriptorOnly);
    let start = Instant::now();
    let times = (0..REQUESTS).map(|i| {
        let start = Instant::now();
        extract(&frames[i % frames.len()])?;
        Ok(start.elapsed())
    });
    let one_by_one = Times::new(times.collect::<anyhow::Result<Vec<_>>>()?, start.elapsed());
    let next = AtomicUsize::new(0);
    let start = Instant::now();
    // As many as keep every session busy and the next frames decoded.
    std::thread::scope(|scope| {
        let work = || {
            while let i = next.fetch_add(1, Ordering::Relaxed)
                && i < REQUESTS
            {
                extract(&frames[i % frames.len()])?;
            }
            anyhow::Ok(())
        };
        let running: Vec<_> = (0..16).map(|_| scope.spawn(work)).collect();
        running.into_iter().try_for_each(|thread| match thread.join() {
            Ok(result) => result,
            Err(_) => anyhow::bail!("a thread panicked"),
        })
    })?;
    Ok((one_by_one, REQUESTS as f64 / start.elapsed().as_secs_f64()))
}

/// One frame after another, each with every kind of descriptor in turn, so that what else the machine does falls on all
/// of them alike.
fn kinds_in_turn(
    extractor: &Extractor,
    frames: &[bytes::Bytes],
) -> anyhow::Result<Vec<(DescriptorKind, Times)>> {
    let kinds = extractor.manifest().kinds();
    let mut times = vec![Vec::new(); kinds.len()];
    for i in 0..REQUESTS {
        for (kind, times) in kinds.iter().zip(&mut times) {
            let start = Instant::now();
            extractor.extract(&frames[i % frames.len()], *kind, FeatureSet::DescriptorOnly)?;
            times.push(start.elapsed());
        }
    }
    let times = times.into_iter().map(|times| {
        let took = times.iter().sum();
        Times::new(times, took)
    });
    Ok(kinds.into_iter().zip(times).collect())
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

/// Adds the images of the town with as many clients as `whereabouts index` uses.
async fn index(server: &Server, town: &Town, batch: f64) -> anyhow::Result<()> {
    const CLIENTS: usize = 8;
    let map = server.http.put(format!("{}/maps/town", server.url)).body("{}");
    map.send().await?.error_for_status()?;
    let pictures = (0..town.places()).map(|place| encode_jpeg(&town.reference(place).image));
    let pictures = pictures.collect::<Result<Vec<_>, _>>()?;
    let start = Instant::now();
    stream::iter(pictures.into_iter().enumerate().map(anyhow::Ok))
        .try_for_each_concurrent(CLIENTS, |(place, picture)| async move {
            let url = format!("{}/maps/town/images?id={place}", server.url);
            let request = server.http.post(url).header("content-type", "image/jpeg");
            request.body(picture).send().await?.error_for_status()?;
            Ok(())
        })
        .await?;
    let per_second = PLACES as f64 / start.elapsed().as_secs_f64();
    println!(
        "indexed {PLACES} images by {CLIENTS} clients                        {per_second:6.1} \
         images/s, {:.2} × the batch job",
        per_second / batch
    );
    Ok(())
}

async fn load(
    server: &Server,
    frames: &[bytes::Bytes],
    clients: usize,
    refine: &'static str,
) -> anyhow::Result<Load> {
    let next = Arc::new(AtomicUsize::new(0));
    let start = Instant::now();
    let mut running = tokio::task::JoinSet::new();
    for _ in 0..clients {
        let (next, http, frames) = (Arc::clone(&next), server.http.clone(), frames.to_vec());
        let url = format!("{}/localize?map=town&refine={refine}", server.url);
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
