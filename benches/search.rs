//! Search among clustered unit vectors of 384 dimensions, one thread: recall and queries a second,
//! against exact search in this process and against hnswlib, faiss and usearch on the same vectors.
//!
//! 76,000 vectors, as many as Tokyo 24/7 has images, or as many as the first argument says:
//! `PYTHON=$(benches/peers/setup.sh) cargo bench --bench search -- 20000`.
//!
//! The peers run in Python, called with all queries at once, so that Python itself costs nothing. All libraries take
//! turns with each beam, so that a disturbance of the machine meets all of them, and the median of the turns counts. A
//! peer that is not installed is skipped with a message.

mod vectors;

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
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
const TURNS: usize = 5;
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
    let folder = tempfile::tempdir()?;
    write(&folder.path().join("vectors"), bytemuck::cast_slice(&rows.numbers))?;
    write(&folder.path().join("queries"), bytemuck::cast_slice(&queries.numbers))?;
    let nearest: Vec<u32> = truth.iter().flatten().map(|&slot| slot as u32).collect();
    write(&folder.path().join("truth"), bytemuck::cast_slice(&nearest))?;
    let mut peers = Vec::new();
    for name in PEERS {
        match Peer::start(name, folder.path()) {
            Ok(peer) => peers.push(peer),
            Err(error) => println!("{name} was not run: {error:#}"),
        }
    }
    let mut ours = Vec::new();
    for ef in EFS {
        let index = filled(ef);
        index.restore(SealedGraph::from_bytes(&bytes)?);
        let mut turns = Vec::new();
        for _ in 0..TURNS {
            let start = Instant::now();
            let found: Vec<_> = (0..QUERIES)
                .map(|query| slots(&index, &rows, queries.row(query), SearchMode::Fast))
                .collect();
            let per_second = QUERIES as f64 / start.elapsed().as_secs_f64();
            turns.push((recall(&found, &truth), per_second));
            peers.iter_mut().try_for_each(|peer| peer.take_turn(ef))?;
        }
        let (recall, per_second) = median(turns);
        println!("sealed graph, ef {ef:3}: recall@10 {recall:.4}, {per_second:.0} queries/s");
        ours.push((recall, per_second));
        for peer in &mut peers {
            let (recall, per_second) = median(std::mem::take(&mut peer.turns));
            println!("{}, ef {ef:3}: recall@10 {recall:.4}, {per_second:.0} queries/s", peer.name);
            peer.points.push((recall, per_second));
        }
    }
    for peer in peers {
        compare(peer.name, (built, &ours), (peer.built, &peer.points));
        peer.end()?;
    }
    Ok(())
}

/// The turn of the median speed.
fn median(mut turns: Vec<(f64, f64)>) -> (f64, f64) {
    turns.sort_by(|a, b| a.1.total_cmp(&b.1));
    turns[turns.len() / 2]
}

/// Prints our speed over a peer's at the recalls that the peer reached. Between two of our points the
/// speed is taken from the line through them.
fn compare(
    peer: &str,
    (built, ours): (f64, &[(f64, f64)]),
    (theirs_built, theirs): (f64, &[(f64, f64)]),
) {
    println!("{peer}: our graph takes {:.2} × its time to build", built / theirs_built);
    for &(recall, per_second) in theirs {
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

/// A library that has built its graph in a process of its own and waits for its turn.
struct Peer {
    name: &'static str,
    process: Child,
    efs: ChildStdin,
    said: Lines<BufReader<ChildStdout>>,
    /// Seconds to build its graph.
    built: f64,
    /// Recall and queries a second of each turn with the present beam.
    turns: Vec<(f64, f64)>,
    /// The medians for each of [`EFS`].
    points: Vec<(f64, f64)>,
}

impl Peer {
    fn start(name: &'static str, folder: &Path) -> anyhow::Result<Self> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/search.py");
        let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".into());
        let mut process = Command::new(python)
            .arg(script)
            .arg(name)
            .arg(folder)
            .args([DIM, K, M, EF_CONSTRUCTION].map(|number| number.to_string()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot start Python")?;
        let efs = process.stdin.take().context("it has no input")?;
        let mut said = BufReader::new(process.stdout.take().context("it has no output")?).lines();
        let built = said.next().context("it ended; its message is above")??.parse()?;
        let (turns, points) = (Vec::new(), Vec::new());
        Ok(Self { name, process, efs, said, built, turns, points })
    }

    fn take_turn(&mut self, ef: usize) -> anyhow::Result<()> {
        writeln!(self.efs, "{ef}")?;
        let line = self.said.next().context("it ended; its message is above")??;
        let (recall, per_second) = line.split_once(' ').context("it said half a line")?;
        self.turns.push((recall.parse()?, per_second.parse()?));
        Ok(())
    }

    fn end(mut self) -> anyhow::Result<()> {
        drop(self.efs);
        anyhow::ensure!(self.process.wait()?.success(), "{} failed at its end", self.name);
        Ok(())
    }
}

fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    Ok(std::fs::File::create(path)?.write_all(bytes)?)
}
