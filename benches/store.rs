//! The embedded store: images a second with group commit and without it, on the disk of the temporary
//! folder; and how long it takes to open a map of 76,000 images, as many as Tokyo 24/7 has, or of as many
//! as the first argument says, with its sealed graph and without.
//!
//! `cargo bench --bench store -- 20000`

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::Context;
use futures_util::{StreamExt, TryStreamExt, stream};
use jiff::Timestamp;
use tempfile::TempDir;
use uuid::Uuid;
use whereabouts_core::{
    CoordinateFrame, Descriptor, DescriptorKind, Digest, Image, Map, MediaType, Precision, Scene,
};
use whereabouts_index::IndexSettings;
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::{DescriptionBounds, MapStore};

const IMAGES: usize = 76_000;
const DIM: usize = 384;
const COMMITTED: usize = 3_000;
const SIDE_BY_SIDE: usize = 64;
/// The argument of a process that only opens a store.
const OPEN: &str = "open";

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [what, dir, ..] = arguments.as_slice()
        && what == OPEN
    {
        return open(Path::new(dir));
    }
    let images = arguments.iter().find_map(|argument| argument.parse().ok()).unwrap_or(IMAGES);
    let mut rates = Vec::new();
    for batch in [1, 256] {
        let dir = TempDir::new()?;
        let store = EmbeddedStore::open(&settings(dir.path(), batch))?;
        let map = new_map(&store).await?;
        let start = Instant::now();
        add(&store, &map, 0..COMMITTED).await?;
        let rate = COMMITTED as f64 / start.elapsed().as_secs_f64();
        println!("{SIDE_BY_SIDE} clients, at most {batch} changes a commit: {rate:.0} images/s");
        rates.push(rate);
    }
    println!("group commit: {:.1} × the images a second", rates[1] / rates[0]);

    let dir = TempDir::new()?;
    let store = EmbeddedStore::open(&settings(dir.path(), 256))?;
    let map = new_map(&store).await?;
    add(&store, &map, 0..images).await?;
    let start = Instant::now();
    let graph = dir.path().join("descriptors").join(map.uid.simple().to_string()).join("graph");
    while store.index_state(&map).await?.behind || !graph.is_file() {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    println!("{images} images; the rest of the graph took {:.0} s", start.elapsed().as_secs_f64());
    close(store, dir.path()).await?;
    for time in ["the first time", "again"] {
        let with = reopen(dir.path())?;
        println!("opened with its graph {time} in {:.2} s", with.as_secs_f64());
    }
    std::fs::remove_file(&graph).with_context(|| graph.display().to_string())?;
    let without = reopen(dir.path())?;
    println!(
        "opened without it in {:.2} s; it is searched exactly meanwhile",
        without.as_secs_f64()
    );
    Ok(())
}

fn settings(dir: &Path, commit_batch: usize) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            exact_up_to: 5000,
            m: 16,
            ef_construction: 200,
            ef_search: 96,
            threads: 0,
            max_dead_share: 0.3,
            check_s: 0,
        },
        index_threads: 2,
        min_free_bytes: 0,
        db_cache_bytes: 64 << 20,
        commit_batch,
        descriptions: DescriptionBounds {
            max_bytes: 1 << 28,
            max_age: Duration::from_secs(86_400),
        },
    }
}

async fn new_map(store: &EmbeddedStore) -> anyhow::Result<Map> {
    let map = Map {
        uid: Uuid::now_v7(),
        name: "bench".parse()?,
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Metric,
        model: "none".into(),
        model_digest: Digest::of(b""),
        precision: Precision::Full,
        dim: DIM,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    };
    Ok(store.put_map(map).await?.0)
}

/// Adds images with clustered descriptors, like those of a town, without picture bytes.
async fn add(
    store: &EmbeddedStore,
    map: &Map,
    numbers: std::ops::Range<usize>,
) -> anyhow::Result<()> {
    let one = |number: usize| async move {
        let place = noise(number as u64 / 38);
        let own = noise(!(number as u64));
        let mixed = place.iter().zip(&own).map(|(place, own)| place + 0.5 * own).collect();
        let image = Image {
            id: format!("image-{number:06}").parse()?,
            digest: Digest::of(&number.to_le_bytes()),
            pose: None,
            captured_at: None,
            tags: Vec::new(),
            media_type: MediaType::Jpeg,
            width: 640,
            height: 480,
            created_at: Timestamp::now(),
        };
        store.add_image(map, image, Descriptor::normalised(mixed)?).await?;
        anyhow::Ok(())
    };
    stream::iter(numbers).map(one).buffer_unordered(SIDE_BY_SIDE).try_collect().await
}

fn noise(seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut next = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    (0..DIM).map(|_| next() + next() + next()).collect()
}

/// Closes a store: its threads and the lock of its database end a moment after it is dropped.
async fn close(store: EmbeddedStore, dir: &Path) -> anyhow::Result<()> {
    drop(store);
    for lock in ["lock", "db/db"] {
        let file = std::fs::File::open(dir.join(lock))?;
        while file.try_lock().is_err() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
    Ok(())
}

/// Opens the store in a new process, like a start of the server; returns how long that took.
fn reopen(dir: &Path) -> anyhow::Result<Duration> {
    let opened = Command::new(std::env::current_exe()?).arg(OPEN).arg(dir).output()?;
    let said = String::from_utf8_lossy(&opened.stdout);
    let seconds = said.trim().parse().with_context(|| {
        format!("could not open the store: {said}{}", String::from_utf8_lossy(&opened.stderr))
    })?;
    Ok(Duration::from_secs_f64(seconds))
}

/// The main function of the process of [`reopen`].
fn open(dir: &Path) -> anyhow::Result<()> {
    let start = Instant::now();
    let store = EmbeddedStore::open(&settings(dir, 256))?;
    println!("{}", start.elapsed().as_secs_f64());
    drop(store);
    Ok(())
}
