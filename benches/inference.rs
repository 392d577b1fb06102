//! DINOv2 ViT-S/14 at 224×224: pictures a second and the time of one alone, by this crate and by ONNX
//! Runtime and OpenVINO in Python on the same file, in turn. The weights are seeded random numbers,
//! which take as long as any.
//!
//! `make openvino` first, else there is only the CPU provider to compare; then
//! `PYTHON=$(benches/peers/setup.sh) cargo bench --bench inference`.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::Context;
use whereabouts::retrieve::{Assets, Bench, BenchRow, BenchSettings, Layout, Wanted};

const MODEL: &str = "dinov2-small";
const SIZE: usize = 224;
const BATCHES: [usize; 3] = [1, 4, 8];
const SECONDS: f64 = 3.0;
const PEERS: [&str; 3] = ["onnxruntime", "openvino-latency", "openvino-throughput"];
/// The machine's speed changes with the moment, so that all are measured in turn, some times over.
const ROUNDS: usize = 3;

#[derive(Debug, Clone, Copy, Default)]
struct Best {
    ms: f64,
    per_second: f64,
}

impl Best {
    fn or(self, other: Self) -> Self {
        let ms = if self.ms == 0.0 { other.ms } else { self.ms.min(other.ms) };
        Self { ms, per_second: self.per_second.max(other.per_second) }
    }
}

fn main() -> anyhow::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/bench-models");
    let file = export(&folder)?;
    let threads = std::thread::available_parallelism()?.get();
    let bench = Bench::open(&Assets::locate(Some(&folder)), MODEL, Wanted::default())?;
    let flop = bench.flop().context("the model is no transformer")?;
    println!("{MODEL} at {SIZE}×{SIZE}, {:.2} GFLOP a picture, {threads} threads", flop / 1e9);
    let execution = best_of_ours(&bench, Wanted::default(), threads, 1)?.execution;
    let wanted =
        Wanted { provider: Some(execution.provider), precision: Some(execution.precision) };
    for batch in BATCHES {
        let (mut ours, mut theirs) = (Best::default(), [Best::default(); PEERS.len()]);
        let mut how = None;
        for _ in 0..ROUNDS {
            let row = best_of_ours(&bench, wanted, threads, batch)?;
            let figures = row.right().context("no descriptors were right")?;
            let ms = figures.alone.as_secs_f64() * 1e3;
            if figures.per_second > ours.per_second {
                how = Some((row.layout.sessions, figures.peak));
            }
            ours = ours.or(Best { ms, per_second: figures.per_second });
            for (peer, best) in PEERS.iter().zip(&mut theirs) {
                *best = best.or(run_peer(peer, &file, batch, threads)?);
            }
        }
        let (sessions, peak) = how.context("nothing was measured")?;
        println!("\nbatch {batch}");
        println!(
            "  whereabouts          {:6.1} pictures/s   ({execution}, {sessions} side by side; \
             {:.0} % of its GEMM peak)",
            ours.per_second,
            100.0 * ours.per_second * flop / peak
        );
        if batch == 1 {
            println!("    a picture alone    {:6.1} ms", ours.ms);
        }
        let mut best = Best::default();
        for (peer, measured) in PEERS.iter().zip(theirs) {
            println!(
                "  {peer:<20} {:6.1} pictures/s   a run alone {:.1} ms",
                measured.per_second, measured.ms
            );
            best = best.or(measured);
        }
        print!("  {:.2} × the best peer's pictures/s", ours.per_second / best.per_second);
        match batch {
            1 => println!(", {:.2} × the time of the quickest alone", ours.ms / best.ms),
            _ => println!(),
        }
    }
    Ok(())
}

/// The way with the most pictures a second, with the least time of a picture alone by any.
fn best_of_ours(
    bench: &Bench,
    wanted: Wanted,
    threads: usize,
    max_batch: usize,
) -> anyhow::Result<BenchRow> {
    let layouts = [1, threads].map(|sessions| Layout { threads, sessions, max_batch }).to_vec();
    let duration = Duration::from_secs_f64(SECONDS / 2.0);
    let settings = BenchSettings { wanted, layouts, duration };
    let rows = bench.run(&settings, |_| {})?;
    let rate = |row: &&BenchRow| row.right().map_or(0.0, |figures| figures.per_second);
    rows.iter().max_by(|a, b| rate(a).total_cmp(&rate(b))).cloned().context("nothing to run")
}

fn run_peer(peer: &str, file: &Path, batch: usize, threads: usize) -> anyhow::Result<Best> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/inference.py");
    let output = Command::new(std::env::var("PYTHON").unwrap_or_else(|_| "python3".into()))
        .arg(script)
        .arg(peer)
        .arg(file)
        .args([SIZE, batch, threads].map(|number| number.to_string()))
        .arg(SECONDS.to_string())
        .output()
        .context("cannot start Python")?;
    let said = String::from_utf8_lossy(&output.stderr);
    anyhow::ensure!(
        output.status.success(),
        "{peer}: {}; PYTHON=$(benches/peers/setup.sh) has all that is needed",
        said.lines().last().unwrap_or_default()
    );
    let text = String::from_utf8(output.stdout)?;
    let (ms, per_second) = text.trim().split_once(' ').context("the peer said nothing")?;
    Ok(Best { ms: ms.parse()?, per_second: per_second.parse()? })
}

/// Makes the model once.
fn export(folder: &Path) -> anyhow::Result<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let model = folder.join("models").join(MODEL);
    let manifest = model.join("manifest.toml");
    if !manifest.exists() {
        let packages = std::fs::read_to_string(root.join("assets/.python"))
            .context("run `make assets` first: it gets the Python packages for this")?;
        let (python, packages) = packages.trim().split_once('\n').context("assets/.python")?;
        let status = Command::new(python)
            .env("PYTHONPATH", packages)
            .arg(root.join("deploy/models/export_dinov2.py"))
            .arg(MODEL)
            .arg(&model)
            .args(["--position", "hub", "--random", "7"])
            .status()?;
        anyhow::ensure!(status.success(), "the model could not be made");
        let text = std::fs::read_to_string(&manifest)?;
        let mut table: toml::Table = text.parse()?;
        let input = table["input"].as_table_mut().context("no input")?;
        input.insert("width".into(), (SIZE as i64).into());
        input.insert("height".into(), (SIZE as i64).into());
        std::fs::write(&manifest, table.to_string())?;
    }
    Ok(model.join("model.onnx"))
}
