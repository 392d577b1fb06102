//! Search among clustered unit vectors of 384 dimensions, one thread: recall and queries a second,
//! against exact search in this process and against hnswlib on the same vectors.
//!
//! 76,000 vectors, as many as Tokyo 24/7 has images, or as many as the first argument says:
//! `cargo bench --bench search -- 20000`.
//!
//! hnswlib runs in Python, called with all queries at once so that Python itself costs nothing:
//! `benches/peers/hnswlib_search.py`, with whatever `python3` finds (`pip install hnswlib numpy`).
//! Without it, its lines are left out and that is said.

use std::io::Write;
use std::ops::Range;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use anyhow::Context;
use rayon::prelude::*;
use whereabouts::retrieve::index::{IndexSettings, MapIndex, SealedGraph, SearchMode, Vectors};

const VECTORS: usize = 76_000;
const QUERIES: usize = 2_000;
const DIM: usize = 384;
const CLUSTERS: usize = 2_000;
const K: usize = 10;
const M: usize = 16;
const EF_CONSTRUCTION: usize = 200;
const EFS: [usize; 6] = [16, 24, 32, 48, 96, 192];

struct Rows(Vec<f32>);

impl Rows {
    fn row(&self, index: usize) -> &[f32] {
        &self.0[index * DIM..(index + 1) * DIM]
    }
}

impl Vectors for Rows {
    fn dim(&self) -> usize {
        DIM
    }

    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32])) {
        slots.for_each(|slot| visit(slot, self.row(slot)));
    }
}

/// Unit vectors around common centres, as those of the places of a town are.
fn clustered(count: usize, seed: u64) -> Rows {
    let mut state = seed;
    let mut random = move || {
        // Four uniform draws make a bell.
        (0..4)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
            })
            .sum::<f32>()
    };
    let mut shared = 1_u64;
    let mut centre = || {
        shared = shared.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (shared >> 40) as f32 / (1_u64 << 24) as f32 - 0.5
    };
    let centres: Vec<f32> = (0..CLUSTERS * DIM).map(|_| centre()).collect();
    let mut rows = Vec::with_capacity(count * DIM);
    for index in 0..count {
        let centre = &centres[index % CLUSTERS * DIM..][..DIM];
        let row: Vec<f32> = centre.iter().map(|x| x + 0.35 * random()).collect();
        let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
        rows.extend(row.iter().map(|x| x / norm));
    }
    Rows(rows)
}

fn settings(ef_search: usize) -> IndexSettings {
    IndexSettings { exact_up_to: 1000, m: M, ef_construction: EF_CONSTRUCTION, ef_search }
}

fn main() -> anyhow::Result<()> {
    let vectors = std::env::args().find_map(|argument| argument.parse().ok()).unwrap_or(VECTORS);
    let (rows, queries) = (clustered(vectors, 7), clustered(QUERIES, 11));
    let filled = |ef| {
        let index = MapIndex::new(settings(ef));
        (0..vectors).for_each(|slot| index.add(slot));
        index
    };
    let index = filled(96);
    let truth: Vec<Vec<usize>> = (0..QUERIES)
        .into_par_iter()
        .map(|query| slots(&index, &rows, queries.row(query), SearchMode::Exact))
        .collect();
    let start = Instant::now();
    for query in 0..50 {
        slots(&index, &rows, queries.row(query), SearchMode::Exact);
    }
    let exact = 50.0 / start.elapsed().as_secs_f64();
    println!("exact: {exact:.0} queries/s");

    let start = Instant::now();
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 1000).or(sealed);
    }
    let bytes = sealed.context("no graph was sealed")?.to_bytes();
    println!(
        "{vectors} built and sealed in {:.1} s; its file has {:.1} MB, {:.2} × the vectors",
        start.elapsed().as_secs_f64(),
        bytes.len() as f64 / 1e6,
        bytes.len() as f64 / (vectors * DIM * 4) as f64
    );
    let start = Instant::now();
    let again = SealedGraph::from_bytes(&bytes)?;
    println!("read in {:.1} ms", start.elapsed().as_secs_f64() * 1e3);
    drop(again);
    let mut ours = Vec::new();
    for ef in EFS {
        let index = filled(ef);
        index.restore(SealedGraph::from_bytes(&bytes)?);
        let start = Instant::now();
        let found: Vec<_> = (0..QUERIES)
            .map(|query| slots(&index, &rows, queries.row(query), SearchMode::Fast))
            .collect();
        let per_second = QUERIES as f64 / start.elapsed().as_secs_f64();
        let recall = recall(&found, &truth);
        println!("sealed graph, ef {ef:3}: recall@10 {recall:.4}, {per_second:.0} queries/s");
        ours.push((recall, per_second));
    }
    match hnswlib(&rows, &queries, &truth) {
        Ok(theirs) => {
            for ((ef, ours), theirs) in EFS.iter().zip(&ours).zip(&theirs) {
                println!(
                    "ef {ef:3}: {:.2} × hnswlib, at recall@10 {:.4} against {:.4}",
                    ours.1 / theirs.1,
                    ours.0,
                    theirs.0
                );
            }
        }
        Err(error) => println!("hnswlib was not run: {error:#}"),
    }
    Ok(())
}

fn slots(index: &MapIndex, rows: &Rows, query: &[f32], mode: SearchMode) -> Vec<usize> {
    index.search(rows, query, K, mode).iter().map(|found| found.slot).collect()
}

fn recall(found: &[Vec<usize>], truth: &[Vec<usize>]) -> f64 {
    let hits = found
        .iter()
        .zip(truth)
        .map(|(found, truth)| found.iter().filter(|slot| truth.contains(slot)).count());
    hits.sum::<usize>() as f64 / (K * truth.len()) as f64
}

/// Recall and queries a second of hnswlib for each of [`EFS`].
fn hnswlib(rows: &Rows, queries: &Rows, truth: &[Vec<usize>]) -> anyhow::Result<Vec<(f64, f64)>> {
    let dir = tempfile::tempdir()?;
    write(&dir.path().join("vectors"), bytemuck::cast_slice(&rows.0))?;
    write(&dir.path().join("queries"), bytemuck::cast_slice(&queries.0))?;
    let truth: Vec<u32> = truth.iter().flatten().map(|&slot| slot as u32).collect();
    write(&dir.path().join("truth"), bytemuck::cast_slice(&truth))?;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/hnswlib_search.py");
    let efs: Vec<String> = EFS.iter().map(usize::to_string).collect();
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".into());
    let output = Command::new(python)
        .arg(script)
        .arg(dir.path())
        .args([DIM, K, M, EF_CONSTRUCTION].map(|number| number.to_string()))
        .args(efs)
        .output()
        .context("cannot start python3")?;
    let said = String::from_utf8_lossy(&output.stderr);
    anyhow::ensure!(output.status.success(), "{}", said.lines().last().unwrap_or_default());
    let mut measured = Vec::new();
    for line in String::from_utf8(output.stdout)?.lines() {
        println!("hnswlib, {line}");
        let number = |name: &str| -> Option<f64> {
            line.split_once(name)?.1.split_whitespace().next()?.trim_end_matches(',').parse().ok()
        };
        if let (Some(recall), Some(per_second)) = (number("recall@10 "), number("speed ")) {
            measured.push((recall, per_second));
        }
    }
    Ok(measured)
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    Ok(std::fs::File::create(path)?.write_all(bytes)?)
}
