//! The graphs of the embedded store.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use rayon::{ThreadPool, ThreadPoolBuilder};
use whereabouts_index::{IndexSettings, MapIndex, SearchMode};

use super::vectors::Set;
use super::{K, median, ms, percentile};

/// Points linked in a turn, as in the store.
const TURN: usize = 64;
/// Larger maps are built with all threads only, and never through the graph of hnsw_rs, which takes ten times as long.
const LARGE: usize = 200_000;

pub fn measure(set: &Set, settings: IndexSettings) -> anyhow::Result<()> {
    let size = set.rows.len();
    let threads = |count| ThreadPoolBuilder::new().num_threads(count).build();
    let all = threads(0)?;
    let before = peak_memory();
    let index = filled(settings, 0..size);
    let built = build(&index, set, &all);
    let memory = peak_memory().zip(before).map(|(after, before)| {
        after.saturating_sub(before) as f64 / (size * set.rows.dim * 4) as f64
    });
    println!(
        "{}: {size} × {}, sealed graph: built in {:.1} s on {} threads, {:.0} MB",
        set.name,
        set.rows.dim,
        built.as_secs_f64(),
        all.current_num_threads(),
        index.sealed_bytes() as f64 / 1e6,
    );
    if let Some(memory) = memory {
        println!("  the process grew by {memory:.2} × the vectors, which it holds besides");
    }
    report("all sealed", set, &index, &BTreeSet::from_iter(0..size));
    if size <= LARGE {
        let one = build(&filled(settings, 0..size), set, &threads(1)?);
        let speedup = one.as_secs_f64() / built.as_secs_f64();
        println!(
            "  built in {:.1} s on one thread: {speedup:.2} × as fast on all",
            one.as_secs_f64()
        );
        let half = filled(settings, 0..size * 11 / 20);
        build(&half, set, &all);
        (size * 11 / 20..size).for_each(|slot| half.add(slot));
        build(&half, set, &all);
        report("45 % growing", set, &half, &BTreeSet::from_iter(0..size));
    }
    rebuild(set, &index, &all)
}

/// Removes so many images that the graph is rebuilt, and searches meanwhile.
fn rebuild(set: &Set, index: &MapIndex, threads: &ThreadPool) -> anyhow::Result<()> {
    let size = set.rows.len();
    // Scattered over all places, by Fibonacci hashing.
    let removed = |slot: &usize| slot.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 60 < 5;
    (0..size).filter(removed).for_each(|slot| index.remove(slot));
    let live = (0..size).filter(|slot| !removed(slot)).collect();
    report("5 of 16 removed", set, index, &live);
    let done = AtomicBool::new(false);
    let mut took = Vec::new();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            build(index, set, threads);
            done.store(true, Ordering::Relaxed);
        });
        for query in (0..set.queries.len()).cycle() {
            if done.load(Ordering::Relaxed) && !took.is_empty() {
                break;
            }
            took.push(search(set, index, set.queries.row(query)).1);
            std::thread::sleep(Duration::from_millis(2));
        }
    });
    let slowest = took.iter().max().copied().context("at least one search was made")?;
    println!(
        "  while it is rebuilt: p50 {:.3} ms, p99 {:.3} ms, slowest {:.1} ms of {} searches",
        ms(median(took.clone())),
        ms(percentile(took.clone(), 0.99)),
        ms(slowest),
        took.len()
    );
    report("rebuilt", set, index, &live);
    Ok(())
}

fn filled(settings: IndexSettings, slots: std::ops::Range<usize>) -> MapIndex {
    let index = MapIndex::new(settings);
    slots.for_each(|slot| index.add(slot));
    index
}

fn build(index: &MapIndex, set: &Set, threads: &ThreadPool) -> Duration {
    let start = Instant::now();
    while index.has_work() {
        index.catch_up(&set.rows, TURN, threads);
    }
    start.elapsed()
}

fn search(set: &Set, index: &MapIndex, query: &[f32]) -> (Vec<usize>, Duration) {
    let start = Instant::now();
    let found = index.search(&set.rows, query, K, SearchMode::Fast);
    (found.iter().map(|found| found.slot).collect(), start.elapsed())
}

/// Prints recall, lost images and latency.
fn report(what: &str, set: &Set, index: &MapIndex, live: &BTreeSet<usize>) {
    let searches = (0..set.queries.len()).map(|query| search(set, index, set.queries.row(query)));
    let (found, took): (Vec<_>, Vec<_>) = searches.unzip();
    let recall = set.recall(&found, &set.truth(live.iter().copied()));
    let sample = set.sample(live.iter().copied().collect());
    let finds_itself = |slot: &&usize| {
        let (found, _) = search(set, index, set.rows.row(**slot));
        set.is_twin(**slot, &found)
    };
    let lost = sample.len() - sample.iter().filter(finds_itself).count();
    println!(
        "  {what}: recall@{K} {recall:.4}, lost {lost} of {}, p50 {:.3} ms, p99 {:.3} ms",
        sample.len(),
        ms(median(took.clone())),
        ms(percentile(took, 0.99))
    );
}

/// The most bytes of memory that the process has held so far, where the system tells.
fn peak_memory() -> Option<usize> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<usize>().ok()? * 1024)
}
