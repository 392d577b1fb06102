//! Growth of a store: the database over many jobs of which only some are kept, and each image on disk and in
//! memory.
//!
//! `cargo bench --bench growth -- [JOBS] [IMAGES]`

#![allow(
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "clippy lets tests do this, and this is one"
)]

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{StreamExt, stream};
use jiff::{SignedDuration, Timestamp};
use uuid::Uuid;
use whereabouts_core::{
    Candidate, CoordinateFrame, Description, Descriptor, DescriptorKind, Digest, Image, Job,
    JobState, Map, MediaType, Precision, RefinerKind, Scene, Usage,
};
use whereabouts_index::IndexSettings;
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore, Examination, compact, examine};
use whereabouts_store::{
    BlobStore, DescriptionBounds, JobRecord, JobRetention, JobStore, MapStore, Query, Retention,
    Step,
};

const KEPT: usize = 1000;
const FRAME_BYTES: usize = 20_000;
const PICTURE_BYTES: usize = 40_000;
const DIM: usize = 576;
const EXACT_UP_TO: usize = 5000;
const SIDE_BY_SIDE: usize = 64;

fn main() {
    let numbers: Vec<usize> = std::env::args().filter_map(|arg| arg.parse().ok()).collect();
    let jobs = numbers.first().copied().unwrap_or(10_000);
    let images = numbers.get(1).copied().unwrap_or(10_000);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(job_cycles(jobs));
    runtime.block_on(map_of(images));
}

fn settings(dir: &Path) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            exact_up_to: EXACT_UP_TO,
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
        commit_batch: 256,
        descriptions: DescriptionBounds {
            max_bytes: 1 << 28,
            max_age: Duration::from_secs(86_400),
        },
    }
}

/// Opens the store, once the threads of an earlier one have ended.
fn open(dir: &Path) -> EmbeddedStore {
    loop {
        match EmbeddedStore::open(&settings(dir)) {
            Ok(store) => return store,
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

fn noise(bytes: usize) -> Bytes {
    let seed = Uuid::now_v7();
    let mut noise = Vec::with_capacity(bytes + 32);
    for block in 0_u32.. {
        if noise.len() >= bytes {
            break;
        }
        noise.extend(Digest::of(format!("{seed}{block}").as_bytes()).hex().into_bytes());
    }
    noise.truncate(bytes);
    noise.into()
}

async fn job_cycles(jobs: usize) {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path());
    println!(
        "{jobs} jobs of 10 pairs, frames of {FRAME_BYTES} bytes, {KEPT} kept\n{:>8} {:>10} {:>10} {:>10} \
         {:>12} {:>12}",
        "jobs", "jobs/s", "db MB", "frames MB", "median ms", "slowest ms"
    );
    for tenth in 1..=10 {
        let start = Instant::now();
        let each = stream::iter(0..jobs / 10).map(|_| one_job(&store));
        let changes = each.buffer_unordered(SIDE_BY_SIDE).collect::<Vec<_>>();
        // Excess jobs are removed meanwhile, as in a server.
        let changes = tokio::select! {
            changes = changes => changes,
            () = sweep(&store) => unreachable!("the sweep never ends"),
        };
        let took = start.elapsed().as_secs_f64();
        let mut changes: Vec<f64> = changes.into_iter().flatten().collect();
        changes.sort_by(f64::total_cmp);
        println!(
            "{:>8} {:>10.0} {:>10.1} {:>10.1} {:>12.1} {:>12.1}",
            tenth * jobs / 10,
            (jobs / 10) as f64 / took,
            store.db_bytes().await.unwrap() as f64 / 1e6,
            bytes_of(&dir.path().join("images")) / 1e6,
            changes[changes.len() / 2],
            changes[changes.len() - 1],
        );
    }
    drop(store);
    let compacted = loop {
        match compact(dir.path()) {
            Ok(compacted) => break compacted,
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    println!(
        "`doctor --compact`: {:.1} MB to {:.1} MB\n",
        compacted.bytes_before as f64 / 1e6,
        compacted.bytes_after as f64 / 1e6
    );
}

async fn sweep(store: &EmbeddedStore) {
    loop {
        let keep = JobRetention { since: None, most: Some(KEPT), settled: Timestamp::now() };
        if store.remove_ended(keep, 64).await.unwrap().jobs() < 64 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
}

/// Runs a job from its submission to its end; returns the time of each change in milliseconds.
async fn one_job(store: &EmbeddedStore) -> Vec<f64> {
    let (now, frame) = (Timestamp::now(), noise(FRAME_BYTES));
    let digest = Digest::of(&frame);
    let candidates: Vec<Candidate> = (0..10)
        .map(|rank| Candidate {
            rank: rank + 1,
            image_id: format!("street/{rank:06}.jpg").parse().unwrap(),
            similarity: 0.9,
            pose: None,
            order: None,
        })
        .collect();
    let query = Uuid::now_v7();
    let job = Job::queued("m".parse().unwrap(), query, RefinerKind::Local, now);
    let query = Query {
        id: query,
        digest,
        media_type: MediaType::Jpeg,
        created_at: now,
        descriptor: None,
        uninformative: None,
    };
    let record = JobRecord {
        job,
        map_uid: Uuid::nil(),
        revision: 0,
        query,
        candidates: candidates.clone(),
        claims: 0,
        traceparent: None,
    };
    let (mut laps, mut since) = (Vec::new(), Instant::now());
    let mut lap = |since: &mut Instant| {
        laps.push(since.elapsed().as_secs_f64() * 1e3);
        *since = Instant::now();
    };
    let _pin = store.put_blob(digest, frame).await.unwrap();
    lap(&mut since);
    store.submit(record, usize::MAX).await.unwrap();
    lap(&mut since);
    // Locked as long as this runs.
    let until = now + SignedDuration::from_hours(1);
    let claimed = store.claim(now, until).await.unwrap().unwrap();
    lap(&mut since);
    for candidate in &candidates {
        let description = Description {
            image_id: candidate.image_id.clone(),
            text: "The same sign over the same door, three windows to its left. ".repeat(6),
            cached: false,
            stands_in: None,
            took_ms: None,
            usage: Usage::default(),
        };
        let step = Step { usage: Usage::default(), description: Some(description) };
        store.progress(claimed.claim(), step).await.unwrap();
        lap(&mut since);
    }
    let record = store.job(claimed.job.id).await.unwrap().unwrap();
    let end = Some(Timestamp::now());
    let job = Job { state: JobState::Succeeded, finished_at: end, ..record.job };
    store.finish(claimed.claim(), job).await.unwrap();
    lap(&mut since);
    laps
}

async fn map_of(images: usize) {
    let dir = tempfile::tempdir().unwrap();
    let store = Arc::new(open(dir.path()));
    let map = Map {
        uid: Uuid::now_v7(),
        name: "m".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "m".into(),
        model_digest: Digest::of(b"m"),
        precision: Precision::Full,
        dim: DIM,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    };
    let (map, _) = store.put_map(map).await.unwrap();
    let before = memory();
    let each = stream::iter(0..images).map(|number| one_image(&store, &map, number));
    let start = Instant::now();
    each.buffer_unordered(SIDE_BY_SIDE).for_each(async |()| {}).await;
    let took = start.elapsed().as_secs_f64();
    // Until the graph is sealed and written.
    let graph = |file: walkdir::DirEntry| file.file_name() == "graph";
    let files = || walkdir::WalkDir::new(dir.path()).into_iter().filter_map(Result::ok);
    while images > EXACT_UP_TO && !files().any(graph) {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let grown = memory().into_iter().zip(before).map(|(after, before)| after - before);
    let grown: Vec<f64> = grown.collect();
    println!(
        "{images} images with descriptors of {DIM} numbers, pictures of {PICTURE_BYTES} bytes, {:.0} \
         images/s\nmemory: {:.0} bytes each of its own, {:.0} bytes each of mapped files",
        images as f64 / took,
        grown[0] / images as f64,
        grown[1] / images as f64
    );
    drop(store);
    let report = loop {
        match examine(dir.path(), Examination::default()) {
            Ok(report) => break report,
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    let each = |bytes: u64| bytes as f64 / images as f64;
    println!(
        "disk: {:.0} bytes each in the database, {:.0} descriptor, {:.0} graph, {:.0} picture",
        each(report.sizes.db),
        each(report.sizes.descriptors),
        each(report.sizes.graphs),
        each(report.sizes.images)
    );
}

async fn one_image(store: &EmbeddedStore, map: &Map, number: usize) {
    let bytes = noise(PICTURE_BYTES);
    let mut state = number as u64;
    let mut random = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    let numbers = (0..DIM).map(|_| random()).collect();
    let image = Image {
        id: format!("street/{number:06}.jpg").parse().unwrap(),
        digest: Digest::of(&bytes),
        pose: None,
        captured_at: None,
        tags: vec![],
        media_type: MediaType::Jpeg,
        width: 640,
        height: 480,
        created_at: Timestamp::now(),
    };
    let _pin = store.put_blob(image.digest, bytes).await.unwrap();
    store.add_image(map, image, Descriptor::normalised(numbers).unwrap()).await.unwrap();
}

/// Resident bytes: anonymous, and of files.
fn memory() -> [f64; 2] {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ["RssAnon:", "RssFile:"].map(|field| {
        let line = status.lines().find(|line| line.starts_with(field));
        let kilobytes = line.and_then(|line| line.split_whitespace().nth(1)?.parse::<f64>().ok());
        kilobytes.unwrap_or(0.0) * 1024.0
    })
}

fn bytes_of(dir: &Path) -> f64 {
    let files = walkdir::WalkDir::new(dir).into_iter().filter_map(Result::ok);
    files.filter_map(|file| file.metadata().ok()).map(|file| file.len() as f64).sum()
}
