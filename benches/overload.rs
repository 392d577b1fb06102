//! The real server at ten times its capacity: the latency of served frames, how soon others are rejected, memory,
//! and the time until it is back at full speed.
//!
//! Robots and server share this machine, so the figures are worse than those of a server on its own machine.
//! Ends with exit code 1 if a promise is not kept.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use bytes::Bytes;
use tokio::task::JoinSet;
use whereabouts_server::config::{Config, Overrides};
use whereabouts_testkit::server::Server;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;

const PLACES: usize = 20;
const ALONE: usize = 300;
const CLIENTS: usize = 16;
const CAPACITY_FOR: Duration = Duration::from_secs(5);
const OVERLOAD_FOR: Duration = Duration::from_secs(10);
const RECOVERY_FOR: Duration = Duration::from_secs(8);
/// The last part of the recovery, when the server should be back at full speed.
const SETTLED_FOR: Duration = Duration::from_secs(4);
const TIMES_CAPACITY: f64 = 10.0;

/// Limits that the run must keep.
const P99_TIMES_P50_TIMES_DEPTH: f64 = 3.0;
const REFUSED_WITHIN: Duration = Duration::from_millis(50);
const RECOVERED_WITHIN: Duration = Duration::from_secs(2);
const MEMORY_GROWTH: f64 = 1.1;
const FULL_SPEED: f64 = 0.9;
const SETTLES_AT: f64 = 0.5;

fn main() -> anyhow::Result<ExitCode> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let town = Town::new(TownSpec { places: PLACES, ..TownSpec::default() });
    let data = tempfile::tempdir()?;
    let server = Server::start_for_benchmark("xfeat", data.path(), &[]);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let kept = runtime.block_on(measure(&server, &town))?;
    Ok(if kept { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

async fn measure(server: &Server, town: &Town) -> anyhow::Result<bool> {
    let config = Config::load(None, &Overrides::default())?;
    let bounds = config.image.admission(config.model.layout());
    let depth = bounds.permits + bounds.queue;
    let robots = Robots::new(server, town).await?;

    let alone = times(robots.one_after_another(ALONE).await?);
    let p50 = at(&alone, 0.5);
    let capacity = rate(&robots.side_by_side(CAPACITY_FOR).await?, CAPACITY_FOR);
    let before = resident(server)?;
    println!("alone                p50 {:6.1} ms  p99 {:6.1} ms", ms(p50), ms(at(&alone, 0.99)));
    println!("{CLIENTS} clients           {capacity:6.1} frames/s");

    let watched = Arc::new(Memory::default());
    let watching = tokio::spawn(Arc::clone(&watched).watch(server.id()));
    let (asking, sending) = robots.offer(capacity * TIMES_CAPACITY, OVERLOAD_FOR).await;
    watched.end.store(true, Ordering::Relaxed);
    let samples = watching.await??;
    let mut recovery = robots.side_by_side(RECOVERY_FOR).await?;
    let after = resident(server)?;
    let overload = Offered { asked: asking.join_all().await, sending };
    recovery.extend(overload.served_after_the_end());

    let (served, refused, others) = overload.sorted();
    println!(
        "offered              {:6.1} frames/s, {:.1} × what it can do, for {} s",
        overload.per_second(),
        overload.per_second() / capacity,
        OVERLOAD_FOR.as_secs()
    );
    println!("served               {:6.1} frames/s", rate(&served, OVERLOAD_FOR));
    ensure!(!served.is_empty() && !refused.is_empty(), "nothing was served, or nothing refused");
    let allowed = p50.mul_f64(P99_TIMES_P50_TIMES_DEPTH * depth as f64);
    let p99 = at(&served, 0.99);
    let late = at(&refused, 0.99);
    let half = samples.len() / 2;
    let most = |part: &[u64]| part.iter().copied().max().unwrap_or(before);
    let (first, second) = (most(&samples[..half]), most(&samples[half..]));
    // The load of other processes on this machine may have changed since the start.
    let settled = rate_after(&recovery, RECOVERY_FOR - SETTLED_FOR);
    let back = full_speed(&recovery, capacity.min(settled) * FULL_SPEED);
    let checks = [
        check(
            p99 <= allowed,
            format!(
                "served: p50 {:.1} ms, p99 {:.1} ms; at most {P99_TIMES_P50_TIMES_DEPTH} × p50 alone \
                 × {depth} in work and waiting = {:.1} ms",
                ms(at(&served, 0.5)),
                ms(p99),
                ms(allowed)
            ),
        ),
        check(
            late <= REFUSED_WITHIN,
            format!(
                "refused: {} frames, p50 {:.1} ms, p99 {:.1} ms, the last after {:.1} ms; p99 at most \
                 {} ms",
                refused.len(),
                ms(at(&refused, 0.5)),
                ms(late),
                ms(at(&refused, 1.0)),
                REFUSED_WITHIN.as_millis()
            ),
        ),
        check(others == 0, format!("{others} requests got neither candidates nor 429")),
        check(
            second as f64 <= MEMORY_GROWTH * first as f64,
            format!(
                "memory: {} MB before, at most {} MB in the first half and {} MB in the second, {} MB \
                 after; the second at most {MEMORY_GROWTH} × the first",
                before >> 20,
                first >> 20,
                second >> 20,
                after >> 20
            ),
        ),
        check(
            back.is_some_and(|back| back <= RECOVERED_WITHIN) && settled >= SETTLES_AT * capacity,
            format!(
                "{settled:.1} frames/s in the end, {:.0} % of that {}; at most {} s after the overload, \
                 and {SETTLES_AT} × the speed before it",
                FULL_SPEED * 100.0,
                back.map_or("never".into(), |back| format!("after {:.2} s", back.as_secs_f64())),
                RECOVERED_WITHIN.as_secs()
            ),
        ),
    ];
    Ok(checks.into_iter().all(|kept| kept))
}

fn check(kept: bool, what: String) -> bool {
    println!("{}  {what}", if kept { "pass" } else { "FAIL" });
    kept
}

/// Clients that post frames.
#[derive(Clone)]
struct Robots {
    http: reqwest::Client,
    url: String,
    frames: Arc<Vec<Bytes>>,
    next: Arc<AtomicUsize>,
}

/// When a frame was posted, counted from the start of the load, and when it was answered and how.
struct Asked {
    status: Option<u16>,
    answered: Duration,
    took: Duration,
}

struct Offered {
    asked: Vec<Asked>,
    sending: Duration,
}

impl Offered {
    fn per_second(&self) -> f64 {
        self.asked.len() as f64 / self.sending.as_secs_f64()
    }

    /// When the frames that were queued at the end of the overload were served, counted from that end.
    fn served_after_the_end(&self) -> impl Iterator<Item = Duration> {
        let served = self.asked.iter().filter(|asked| asked.status == Some(200));
        served.filter_map(|asked| asked.answered.checked_sub(self.sending))
    }

    /// Latencies in ascending order of the served and of the rejected frames, and the number of frames that were
    /// neither.
    fn sorted(&self) -> (Vec<Duration>, Vec<Duration>, usize) {
        let of = |status: u16| {
            let like = self.asked.iter().filter(|asked| asked.status == Some(status));
            times(like.map(|asked| asked.took))
        };
        let (served, refused) = (of(200), of(429));
        let others = self.asked.len() - served.len() - refused.len();
        (served, refused, others)
    }
}

impl Robots {
    /// Indexes the town and renders frames of it.
    async fn new(server: &Server, town: &Town) -> anyhow::Result<Self> {
        let map = server.http.put(format!("{}/maps/town", server.url)).body("{}");
        map.send().await?.error_for_status()?;
        let mut frames = Vec::new();
        for place in 0..town.places() {
            let url = format!("{}/maps/town/images?id={place}", server.url);
            let request = server.http.post(url).header("content-type", "image/jpeg");
            let picture = encode_jpeg(&town.reference(place).image)?;
            request.body(picture).send().await?.error_for_status()?;
            frames.push(encode_jpeg(&town.query(place, 0).image)?.into());
        }
        Ok(Self {
            http: server.http.clone(),
            url: format!("{}/localize?map=town&refine=off", server.url),
            frames: frames.into(),
            next: Arc::default(),
        })
    }

    /// Posts one frame; a broken connection has no status.
    async fn ask(&self, start: Instant) -> Asked {
        let frame = &self.frames[self.next.fetch_add(1, Ordering::Relaxed) % self.frames.len()];
        let request = self.http.post(&self.url).header("content-type", "image/jpeg");
        let posted = start.elapsed();
        let status = async {
            let response = request.body(frame.clone()).send().await?;
            let status = response.status().as_u16();
            response.bytes().await?;
            Ok::<_, reqwest::Error>(status)
        };
        let status = status.await.ok();
        Asked { status, answered: start.elapsed(), took: start.elapsed() - posted }
    }

    async fn one_after_another(&self, frames: usize) -> anyhow::Result<Vec<Duration>> {
        let start = Instant::now();
        let mut took = Vec::new();
        for _ in 0..frames {
            let asked = self.ask(start).await;
            ensure!(asked.status == Some(200), "a frame alone was answered {:?}", asked.status);
            took.push(asked.took);
        }
        Ok(took)
    }

    /// Runs clients that each post the next frame when the last is answered; returns when frames were served.
    async fn side_by_side(&self, span: Duration) -> anyhow::Result<Vec<Duration>> {
        let start = Instant::now();
        let mut clients = JoinSet::new();
        for _ in 0..CLIENTS {
            let robots = self.clone();
            clients.spawn(async move {
                let mut answered = Vec::new();
                while start.elapsed() < span {
                    let asked = robots.ask(start).await;
                    answered.extend((asked.status == Some(200)).then_some(asked.answered));
                }
                answered
            });
        }
        Ok(clients.join_all().await.concat())
    }

    /// Posts at a constant rate without waiting for responses; returns how long the posting took.
    async fn offer(&self, per_second: f64, span: Duration) -> (JoinSet<Asked>, Duration) {
        let start = Instant::now();
        let (mut asking, mut sent) = (JoinSet::new(), 0);
        let mut ticks = tokio::time::interval(Duration::from_millis(2));
        while start.elapsed() < span {
            ticks.tick().await;
            while (sent as f64) < start.elapsed().as_secs_f64() * per_second {
                let robots = self.clone();
                asking.spawn(async move { robots.ask(start).await });
                sent += 1;
            }
        }
        (asking, start.elapsed())
    }
}

/// Samples the resident memory of a process.
#[derive(Default)]
struct Memory {
    end: AtomicBool,
}

impl Memory {
    async fn watch(self: Arc<Self>, process: u32) -> anyhow::Result<Vec<u64>> {
        let mut samples = Vec::new();
        let mut ticks = tokio::time::interval(Duration::from_millis(100));
        while !self.end.load(Ordering::Relaxed) {
            ticks.tick().await;
            samples.push(resident_of(process)?);
        }
        Ok(samples)
    }
}

fn resident(server: &Server) -> anyhow::Result<u64> {
    resident_of(server.id())
}

/// Bytes.
fn resident_of(process: u32) -> anyhow::Result<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next()).context("no VmRSS")?;
    Ok(kib.parse::<u64>()? * 1024)
}

/// Responses per second from a moment until the end of the recovery.
fn rate_after(answered: &[Duration], start: Duration) -> f64 {
    let counted = answered.iter().filter(|at| (start..RECOVERY_FOR).contains(*at)).count();
    counted as f64 / (RECOVERY_FOR - start).as_secs_f64()
}

/// The first second that reached a rate.
fn full_speed(answered: &[Duration], per_second: f64) -> Option<Duration> {
    const WINDOW: Duration = Duration::from_secs(1);
    let starts = (0..).map(|step| Duration::from_millis(100) * step);
    starts.take_while(|start| *start + WINDOW <= RECOVERY_FOR).find(|start| {
        let within = |at: &&Duration| **at >= *start && **at < *start + WINDOW;
        answered.iter().filter(within).count() as f64 >= per_second
    })
}

fn times(times: impl IntoIterator<Item = Duration>) -> Vec<Duration> {
    let mut times: Vec<Duration> = times.into_iter().collect();
    times.sort();
    times
}

/// A quantile of times in ascending order, of which there must be at least one.
fn at(sorted: &[Duration], share: f64) -> Duration {
    sorted[((sorted.len() - 1) as f64 * share) as usize]
}

fn rate(answered: &[Duration], span: Duration) -> f64 {
    answered.len() as f64 / span.as_secs_f64()
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
