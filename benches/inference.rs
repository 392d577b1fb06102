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
use whereabouts_vision::{Assets, Bench, BenchRow, BenchSettings, Layout, ProviderPreference};

const MODEL: &str = "dinov2-small";
const SIZE: usize = 224;
/// Pictures in a run; the arguments may say others.
const BATCHES: [usize; 3] = [1, 4, 8];
const SECONDS: f64 = 1.5;
const PEERS: [&str; 3] = ["onnxruntime", "openvino-latency", "openvino-throughput"];
/// The machine's speed changes with the moment: all are measured in turn, some times over, and what
/// counts is the median of the ratios of each round.
const ROUNDS: usize = 4;

#[derive(Debug, Clone, Copy)]
struct Measured {
    /// The time of a run alone, in milliseconds.
    ms: f64,
    per_second: f64,
}

fn main() -> anyhow::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/bench-models");
    let file = export(&folder)?;
    let threads = std::thread::available_parallelism()?.get();
    let bench = Bench::open(&Assets::locate(Some(&folder)), MODEL, ProviderPreference::default())?;
    let flop = bench.flop().context("the model is no transformer")?;
    println!("{MODEL} at {SIZE}×{SIZE}, {:.2} GFLOP a picture, {threads} threads", flop / 1e9);
    let execution =
        fastest(&run_ours(&bench, ProviderPreference::default(), threads, 1)?)?.execution;
    let preference = ProviderPreference {
        provider: Some(execution.provider),
        precision: Some(execution.precision),
    };
    let asked: Vec<usize> = std::env::args().filter_map(|argument| argument.parse().ok()).collect();
    for batch in if asked.is_empty() { BATCHES.to_vec() } else { asked } {
        println!("\nbatch {batch}; whereabouts by {execution}");
        let (mut more, mut longer) = (Vec::new(), Vec::new());
        for _ in 0..ROUNDS {
            let rows = run_ours(&bench, preference, threads, batch)?;
            let most = fastest(&rows)?;
            let figures = most.accepted().context("no descriptors were right")?;
            let alone = rows.iter().filter_map(|row| Some(row.accepted()?.alone)).min();
            let alone = alone.context("no descriptors were right")?.as_secs_f64() * 1e3;
            print!(
                "  whereabouts {:.1}/s (runs of {}, {} side by side, {:.0} % of GEMM), alone {alone:.1} ms",
                figures.per_second,
                most.layout.max_batch,
                most.layout.sessions,
                100.0 * figures.per_second * flop / figures.peak
            );
            let mut peers = Vec::new();
            for peer in PEERS {
                let measured = run_peer(peer, &file, batch, threads)?;
                print!("; {peer} {:.1}/s, {:.1} ms", measured.per_second, measured.ms);
                peers.push(measured);
            }
            println!();
            let best = peers.iter().map(|peer| peer.per_second).fold(0.0, f64::max);
            let quickest = peers.iter().map(|peer| peer.ms).fold(f64::MAX, f64::min);
            more.push(figures.per_second / best);
            longer.push(alone / quickest);
        }
        println!("  {:.2} × the best peer's pictures/s (median of the rounds)", median(more));
        if batch == 1 {
            println!("  {:.2} × the time of the quickest peer for one alone", median(longer));
        }
    }
    Ok(())
}

/// The middle one, or the mean of the two in the middle.
fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    (numbers[(numbers.len() - 1) / 2] + numbers[numbers.len() / 2]) / 2.0
}

/// One run after another and side by side, of one picture and of the whole batch: as a server does that
/// is configured by `whereabouts model bench --write`.
fn run_ours(
    bench: &Bench,
    preference: ProviderPreference,
    threads: usize,
    max_batch: usize,
) -> anyhow::Result<Vec<BenchRow>> {
    let batches = if max_batch == 1 { vec![1] } else { vec![1, max_batch] };
    let layout = |max_batch| [1, threads].map(|sessions| Layout { threads, sessions, max_batch });
    let layouts = batches.into_iter().flat_map(layout).collect();
    let duration = Duration::from_secs_f64(SECONDS);
    Ok(bench.run(&BenchSettings { preference, layouts, duration }, |_| {})?)
}

/// The row with the most pictures a second.
fn fastest(rows: &[BenchRow]) -> anyhow::Result<&BenchRow> {
    let rate = |row: &&BenchRow| row.accepted().map_or(0.0, |figures| figures.per_second);
    rows.iter().max_by(|a, b| rate(a).total_cmp(&rate(b))).context("nothing was run")
}

fn run_peer(peer: &str, file: &Path, batch: usize, threads: usize) -> anyhow::Result<Measured> {
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
    Ok(Measured { ms: ms.parse()?, per_second: per_second.parse()? })
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
        table.insert("name".into(), MODEL.into());
        let input = table["input"].as_table_mut().context("no input")?;
        input.insert("width".into(), (SIZE as i64).into());
        input.insert("height".into(), (SIZE as i64).into());
        std::fs::write(&manifest, table.to_string())?;
    }
    Ok(model.join("model.onnx"))
}
