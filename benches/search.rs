//! Search among clustered unit vectors of 384 dimensions, one thread: recall and queries a second,
//! against exact search in this process and against hnswlib, faiss and usearch on the same vectors.
//!
//! 76,000 vectors, as many as Tokyo 24/7 has images, or as many as the first argument says:
//! `PYTHON=$(benches/peers/setup.sh) cargo bench --bench search -- 20000`.
//!
//! The peers run in Python, called with all queries at once, so that Python itself costs nothing. A
//! peer that is not installed is skipped with a message.

mod vectors;

use std::io::Write;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use anyhow::Context;
use rayon::prelude::*;
use whereabouts_index::{IndexSettings, MapIndex, SealedGraph, SearchMode};

use self::vectors::{DIM, Rows, clustered, recall};

const VECTORS: usize = 76_000;
const QUERIES: usize = 2_000;
const K: usize = 10;
const M: usize = 16;
const EF_CONSTRUCTION: usize = 200;
const EFS: [usize; 6] = [16, 24, 32, 48, 96, 192];
const PEERS: [&str; 3] = ["hnswlib", "faiss", "usearch"];

fn settings(ef_search: usize) -> IndexSettings {
    IndexSettings {
        exact_up_to: 1000,
        m: M,
        ef_construction: EF_CONSTRUCTION,
        ef_search,
        threads: 0,
        max_dead_share: 1.0,
        check_s: 0,
    }
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

    let threads = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let start = Instant::now();
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 1000, &threads).or(sealed);
    }
    let built = start.elapsed().as_secs_f64();
    let bytes = sealed.context("no graph was sealed")?.to_bytes();
    println!(
        "{vectors} built and sealed in {built:.1} s; its file has {:.1} MB, {:.2} × the vectors",
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
    for peer in PEERS {
        match run_peer(peer, &rows, &queries, &truth) {
            Ok(theirs) => compare(peer, (built, &ours), &theirs),
            Err(error) => println!("{peer} was not run: {error:#}"),
        }
    }
    Ok(())
}

/// Prints our speed over a peer's at the recalls that the peer reached. Between two of our points the
/// speed is taken from the line through them.
fn compare(peer: &str, (built, ours): (f64, &[(f64, f64)]), theirs: &Measured) {
    println!("{peer}: our graph takes {:.2} × its time to build", built / theirs.built);
    for &(recall, per_second) in &theirs.points {
        let above = ours.iter().position(|point| point.0 >= recall);
        let Some(above) = above else {
            println!("{peer}: at recall@10 {recall:.4} there is nothing of ours to compare");
            continue;
        };
        let speed = match above.checked_sub(1).map(|below| (ours[below], ours[above])) {
            Some((low, high)) if high.0 > low.0 => {
                low.1 + (high.1 - low.1) * (recall - low.0) / (high.0 - low.0)
            }
            _ => ours[above].1,
        };
        println!(
            "{peer}: at recall@10 {recall:.4}, {:.2} × its queries a second",
            speed / per_second
        );
    }
}

fn slots(index: &MapIndex, rows: &Rows, query: &[f32], mode: SearchMode) -> Vec<usize> {
    index.search(rows, query, K, mode).iter().map(|found| found.slot).collect()
}

/// The result of a peer.
struct Measured {
    /// Seconds to build its graph.
    built: f64,
    /// Recall and queries a second for each of [`EFS`].
    points: Vec<(f64, f64)>,
}

fn run_peer(
    peer: &str,
    rows: &Rows,
    queries: &Rows,
    truth: &[Vec<usize>],
) -> anyhow::Result<Measured> {
    let dir = tempfile::tempdir()?;
    write(&dir.path().join("vectors"), bytemuck::cast_slice(&rows.numbers))?;
    write(&dir.path().join("queries"), bytemuck::cast_slice(&queries.numbers))?;
    let truth: Vec<u32> = truth.iter().flatten().map(|&slot| slot as u32).collect();
    write(&dir.path().join("truth"), bytemuck::cast_slice(&truth))?;
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/search.py");
    let efs: Vec<String> = EFS.iter().map(usize::to_string).collect();
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".into());
    let output = Command::new(python)
        .arg(script)
        .arg(peer)
        .arg(dir.path())
        .args([DIM, K, M, EF_CONSTRUCTION].map(|number| number.to_string()))
        .args(efs)
        .output()
        .context("cannot start Python")?;
    let said = String::from_utf8_lossy(&output.stderr);
    anyhow::ensure!(output.status.success(), "{}", said.lines().last().unwrap_or_default());
    let text = String::from_utf8(output.stdout)?;
    let mut lines = text.lines();
    let built = lines.next().context("it said nothing")?.parse()?;
    let mut points = Vec::new();
    for (ef, line) in EFS.iter().zip(lines) {
        let (recall, per_second) = line.split_once(' ').context("it said half a line")?;
        let (recall, per_second): (f64, f64) = (recall.parse()?, per_second.parse()?);
        println!("{peer}, ef {ef:3}: recall@10 {recall:.4}, {per_second:.0} queries/s");
        points.push((recall, per_second));
    }
    Ok(Measured { built, points })
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    Ok(std::fs::File::create(path)?.write_all(bytes)?)
}
