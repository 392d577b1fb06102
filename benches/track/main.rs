//! How well a track is located, against the frame alone, two simple filters, and the sequence matching of SeqSLAM, in
//! one run on drives through the town; on real traverses too, if there are any in `../shared/data` or
//! `WHEREABOUTS_DATA`. Then how long a step takes in a map of 100,000 images.
//!
//! The arguments name the drives to run, by default all, and `kind=gem` the kind of descriptor, by default the model's.
//! `tests/support/drives.rs` describes the other methods.

mod sets;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt, future, stream};
use jiff::{SignedDuration, Timestamp};
use tempfile::TempDir;
use tokio::runtime::Runtime;
use uuid::Uuid;
use whereabouts_core::{
    CoordinateFrame, Descriptor, DescriptorKind, Digest, Image, Map, MediaType, MetricPose, Pose,
    Precision, Scene, dot,
};
use whereabouts_index::{IndexSettings, SearchMode};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_service::{Odometry, Principal, TrackStep, Tracks};
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::{BlobStore, DescriptionBounds, MapStore};
use whereabouts_testkit::drives;

use self::sets::Drive;

/// Images of the map in which a step is timed.
const LARGE: usize = 100_000;
/// Numbers in each of its descriptors.
const LARGE_DIM: usize = 512;
/// Timed steps.
const STEPS: usize = 300;

fn main() -> anyhow::Result<()> {
    let mut names: Vec<String> =
        std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).collect();
    let kind = names.iter().find_map(|name| name.strip_prefix("kind="));
    let kind: Option<DescriptorKind> = kind.map(str::parse).transpose()?;
    names.retain(|name| !name.starts_with("kind="));
    let is_named =
        |name: &str| names.is_empty() || names.iter().any(|wanted| name.contains(wanted.as_str()));
    let runtime = Runtime::new()?;
    println!(
        "{:<28}{:>7}{:>7}{:>7}{:>9}{:>8}{:>10}   ≥ 0.9: right of     known: right wrong",
        "R@1 in percent", "alone", "A", "B", "SeqSLAM", "times", "odometry"
    );
    let mut total = Tally::default();
    for drive in sets::all(kind)?.into_iter().filter(|drive| is_named(&drive.name)) {
        let others = Others::of(&drive);
        let mut tally = Tally::default();
        let mut ours = Vec::new();
        for with_odometry in [false, true] {
            let answers = runtime.block_on(follow(&drive, with_odometry))?;
            ours.push(drive.right(answers.iter().map(|answer| answer.image)));
            tally.add(&drive, &answers);
        }
        println!(
            "{:<28}{:>7.1}{:>7.1}{:>7.1}{:>9.1}{:>8.1}{:>10.1}   {}",
            drive.name, others.alone, others.a, others.b, others.line, ours[0], ours[1], tally
        );
        total.merge(&tally);
    }
    println!("all drives: {total}");
    println!("{}", total.diagram());
    if is_named("large") {
        runtime.block_on(large())?;
    }
    Ok(())
}

/// R@1 of the other methods.
struct Others {
    alone: f64,
    a: f64,
    b: f64,
    line: f64,
}

impl Others {
    fn of(drive: &Drive) -> Self {
        let row = |frame: &Descriptor| -> Vec<f32> {
            drive.map.iter().map(|(image, _)| dot(frame.as_slice(), image.as_slice())).collect()
        };
        let rows: Vec<Vec<f32>> = drive.frames.iter().map(|frame| row(&frame.descriptor)).collect();
        let right = |answers: Vec<usize>| drive.right(answers.into_iter().map(Some));
        Self {
            alone: right(drives::alone(&rows)),
            a: right(drives::with_odometry(&rows)),
            b: right(drives::without_odometry(&rows)),
            line: right(drives::best_line(&rows)),
        }
    }
}

/// Where a track is after a frame.
struct Located {
    image: Option<usize>,
    probability: f64,
    known: bool,
}

/// Right and wrong answers by probability, in tenths, and those that are known.
#[derive(Default)]
struct Tally {
    tenths: [[usize; 2]; 10],
    known: [usize; 2],
}

impl Tally {
    fn add(&mut self, drive: &Drive, answers: &[Located]) {
        for (number, answer) in answers.iter().enumerate() {
            let right = usize::from(drive.is_right(number, answer.image));
            self.tenths[((answer.probability * 10.0) as usize).min(9)][right] += 1;
            self.known[right] += usize::from(answer.known);
        }
    }

    fn merge(&mut self, other: &Self) {
        let tenths = self.tenths.iter_mut().zip(&other.tenths);
        for (sum, other) in tenths.chain([(&mut self.known, &other.known)]) {
            sum.iter_mut().zip(other).for_each(|(sum, other)| *sum += other);
        }
    }

    /// The share of right answers for each tenth of probability.
    fn diagram(&self) -> String {
        let line = |(tenth, [wrong, right]): (usize, &[usize; 2])| {
            let answers = wrong + right;
            let share = 100.0 * *right as f64 / answers.max(1) as f64;
            format!("probability {:.1}: {share:5.1} % of {answers} right\n", tenth as f64 / 10.0)
        };
        self.tenths.iter().enumerate().map(line).collect()
    }
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [wrong, right] = self.tenths[9];
        let sure = wrong + right;
        let share = 100.0 * right as f64 / sure.max(1) as f64;
        write!(f, "{share:5.1} % of {sure:>4}     {:>6} {:>5}", self.known[1], self.known[0])
    }
}

/// A store with one map, and the tracks in it.
struct Robots {
    store: Arc<EmbeddedStore>,
    tracks: Tracks,
    map: Map,
    _folder: TempDir,
}

impl Robots {
    async fn new(images: &[(Descriptor, [f64; 2])]) -> anyhow::Result<Self> {
        let folder = TempDir::new()?;
        let config = Config::load(None, &Overrides::default())?;
        let store = Arc::new(EmbeddedStore::open(&settings(folder.path()))?);
        let tracks = Tracks::new(store.clone(), config.confidence.place_m, config.track);
        let map = Map {
            uid: Uuid::now_v7(),
            name: "drive".parse()?,
            scene: Scene::Outdoor,
            descriptor: DescriptorKind::GEM,
            frame: CoordinateFrame::Metric,
            model: "xfeat".into(),
            model_digest: Digest::of(b"model"),
            precision: Precision::Full,
            dim: images.first().context("no images")?.0.as_slice().len(),
            revision: 0,
            refiner: None,
            description: None,
            created_at: Timestamp::now(),
        };
        let (map, _) = store.put_map(map).await?;
        let digest = Digest::of(b"picture");
        let _pin = store.put_blob(digest, Bytes::from_static(b"picture")).await?;
        let adding = images.iter().enumerate().map(|(number, (descriptor, [x, y]))| {
            let image = Image {
                id: id(number).parse().unwrap_or_else(|_| unreachable!("the id is valid")),
                digest,
                pose: Some(metric(*x, *y)),
                captured_at: None,
                tags: Vec::new(),
                media_type: MediaType::Jpeg,
                width: 1,
                height: 1,
                created_at: Timestamp::now(),
            };
            store.add_image(&map, image, descriptor.clone())
        });
        // In order, and many in one commit.
        stream::iter(adding).buffered(2048).try_for_each(|_| future::ready(Ok(()))).await?;
        Ok(Self { store, tracks, map, _folder: folder })
    }

    /// One step of a track. Returns what the filter answers, and the milliseconds that it took.
    async fn step(
        &self,
        step: TrackStep,
        frame: &Descriptor,
        mode: SearchMode,
    ) -> anyhow::Result<(Located, f64)> {
        let k = self.tracks.candidates();
        let candidates = self.store.search(&self.map, frame.clone(), k, mode).await?;
        let start = Instant::now();
        let (estimate, _) = self.tracks.follow(&self.map, step, frame, Some(&candidates)).await?;
        let elapsed = start.elapsed().as_secs_f64() * 1e3;
        let number = |id: &str| id.trim_start_matches("image-").parse().ok();
        let image = estimate.image_id.and_then(|id| number(id.as_str()));
        Ok((Located { image, probability: estimate.probability, known: estimate.known }, elapsed))
    }
}

fn settings(dir: &Path) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            // Graphs have nothing to do with tracks.
            exact_up_to: 2 * LARGE,
            m: 16,
            ef_construction: 200,
            ef_search: 96,
            threads: 0,
            max_dead_share: 0.3,
            check_s: 0,
        },
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 64 << 20,
        commit_batch: 4096,
        descriptions: DescriptionBounds {
            max_bytes: 1 << 28,
            max_age: Duration::from_secs(86_400),
        },
    }
}

fn id(number: usize) -> String {
    format!("image-{number:06}")
}

fn metric(x: f64, y: f64) -> Pose {
    Pose::Metric(MetricPose { x, y, z: None, qx: None, qy: None, qz: None, qw: None })
}

fn step_at(seconds: f64, odometry: Option<f64>) -> anyhow::Result<TrackStep> {
    let at = Timestamp::UNIX_EPOCH + SignedDuration::try_from_secs_f64(seconds)?;
    let odometry = odometry.map(Odometry::distance).transpose()?;
    Ok(TrackStep::new(&Principal::Anonymous, "robot".into(), Some(at), odometry)?)
}

async fn follow(drive: &Drive, with_odometry: bool) -> anyhow::Result<Vec<Located>> {
    let robots = Robots::new(&drive.map).await?;
    let mut answers = Vec::new();
    for frame in &drive.frames {
        let step = step_at(frame.seconds, with_odometry.then_some(frame.moved_m))?;
        answers.push(robots.step(step, &frame.descriptor, SearchMode::Exact).await?.0);
    }
    Ok(answers)
}

/// Times steps in a large map: a robot that drives along it, and one that is lost.
async fn large() -> anyhow::Result<()> {
    let rows = sets::drawn(LARGE, LARGE_DIM)?;
    let robots = Robots::new(&rows).await?;
    for (name, stride) in [("that drives", 1), ("that is carried each time", 7919)] {
        for with_odometry in [true, false] {
            let mut times = Vec::new();
            for number in 0..STEPS {
                let place = (1000 + number * stride) % LARGE;
                let step = step_at(number as f64, with_odometry.then_some(1.0))?;
                let (_, ms) = robots.step(step, &rows[place].0, SearchMode::Exact).await?;
                times.push(ms);
            }
            // The first step reads the map.
            let mut times = times.split_off(1);
            times.sort_by(f64::total_cmp);
            let by = if with_odometry { "with odometry" } else { "without" };
            println!(
                "a step in a map of {LARGE} images of a robot {name}, {by}: median {:.2} ms, 95th percentile {:.2} ms",
                times[times.len() / 2],
                times[times.len() * 95 / 100]
            );
        }
    }
    Ok(())
}
