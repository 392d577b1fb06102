//! `whereabouts model bench`: finds the fastest way to run a model on this machine.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::json;
use toml_edit::{DocumentMut, Item, Table, value};

use super::ModelContext;
use whereabouts_vision::{Bench, BenchRow, BenchSettings, Layout, MIN_SIMILARITY};

/// Benchmark a model on this machine with every provider, precision, thread count and batch size
#[derive(Debug, clap::Args)]
pub struct BenchArgs {
    /// Name of the model [default: the default model of the server]
    name: Option<String>,
    /// Numbers of threads to try [default: one, and one per core]
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    threads: Vec<usize>,
    /// Numbers of images to run concurrently; no more than there are threads
    #[arg(long, value_delimiter = ',', default_value = "1,2", value_name = "N,…")]
    sessions: Vec<usize>,
    /// Batch sizes to try
    #[arg(long, value_delimiter = ',', default_value = "1,4", value_name = "N,…")]
    batch: Vec<usize>,
    /// Duration of each measurement
    #[arg(long, default_value_t = 2.0, value_name = "SECONDS")]
    seconds: f64,
    /// Write the best settings into the section [model] of this configuration file
    #[arg(long, value_name = "FILE")]
    write: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(context: &ModelContext, args: BenchArgs) -> anyhow::Result<()> {
    if !(0.05..=600.0).contains(&args.seconds) {
        bail!("--seconds must be between 0.05 and 600");
    }
    let preference = context.config.model.preference();
    let (name, why) =
        context.assets.resolve(args.name.as_deref().unwrap_or(&context.config.model.name))?;
    let bench = Bench::open(&context.assets, &name, preference)?;
    let settings = BenchSettings {
        preference,
        layouts: layouts(&args),
        duration: Duration::from_secs_f64(args.seconds),
    };
    if settings.layouts.is_empty() {
        bail!("nothing to measure: a value of --sessions must not exceed one of --threads");
    }
    if !args.json {
        println!("{name} ({why}), on street images, with each provider and precision available\n");
        println!("{HEADING}");
    }
    let rows = bench.run(&settings, |row| {
        if !args.json {
            println!("{}", line(row, bench.flop()));
        }
    })?;
    let best = best(&rows);
    if args.json {
        let rows: Vec<_> = rows.iter().map(|row| to_json(row, bench.flop())).collect();
        let best = best.map(|row| to_json(row, bench.flop()));
        println!(
            "{}",
            serde_json::to_string_pretty(&json!({"model": name, "rows": rows, "best": best}))?
        );
    }
    let Some(best) = best else {
        bail!("no configuration of {name} gives correct descriptors; the reasons are listed above");
    };
    if !args.json {
        let Layout { threads, sessions, max_batch } = best.layout;
        println!(
            "\nhighest throughput: {}, {threads} threads, {sessions} concurrent, batches of up to \
             {max_batch}",
            best.execution
        );
    }
    match &args.write {
        Some(file) => {
            write(file, best)?;
            eprintln!("wrote the settings to [model] in {}", file.display());
        }
        None => eprintln!(
            "to keep these settings, write them to a configuration file with --write FILE"
        ),
    }
    Ok(())
}

fn layouts(args: &BenchArgs) -> Vec<Layout> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut threads = match args.threads.as_slice() {
        [] => vec![1, cores],
        threads => threads.to_vec(),
    };
    threads.dedup();
    let pairs = threads.iter().flat_map(|&threads| {
        let sessions = args.sessions.iter().filter(move |&&sessions| sessions <= threads);
        sessions.map(move |&sessions| (threads, sessions))
    });
    pairs
        .flat_map(|(threads, sessions)| {
            args.batch.iter().map(move |&max_batch| Layout { threads, sessions, max_batch })
        })
        .filter(|layout| layout.threads > 0 && layout.sessions > 0 && layout.max_batch > 0)
        .collect()
}

/// Returns the row with the lowest latency among those with at least 95 % of the highest throughput.
fn best(rows: &[BenchRow]) -> Option<&BenchRow> {
    let correct = || rows.iter().filter_map(|row| Some((row, row.accepted()?)));
    let highest = correct().map(|(_, figures)| figures.per_second).fold(0.0, f64::max);
    correct()
        .filter(|(_, figures)| figures.per_second >= 0.95 * highest)
        .min_by_key(|(_, figures)| figures.alone)
        .map(|(row, _)| row)
}

const HEADING: &str = "provider  precision  threads  concurrent  batch  alone ms  images/s  \
                       cosine   of GEMM peak";

fn line(row: &BenchRow, flop: Option<f64>) -> String {
    let Layout { threads, sessions, max_batch } = row.layout;
    let (provider, precision) = (row.execution.provider, row.execution.precision);
    let columns =
        format!("{provider:<8}  {precision:<9}  {threads:>7}  {sessions:>10}  {max_batch:>5}");
    match &row.outcome {
        Ok(figures) => {
            let share = flop.map_or("-".to_owned(), |flop| {
                format!("{:.0} %", 100.0 * figures.per_second * flop / figures.peak)
            });
            let wrong =
                if figures.similarity < MIN_SIMILARITY { "  descriptors differ" } else { "" };
            format!(
                "{columns}  {:>8.1}  {:>8.1}  {:.5}  {share:>12}{wrong}",
                figures.alone.as_secs_f64() * 1e3,
                figures.per_second,
                figures.similarity
            )
        }
        Err(why) => format!("{columns}  cannot be used: {why}"),
    }
}

fn to_json(row: &BenchRow, flop: Option<f64>) -> serde_json::Value {
    let figures = row.outcome.as_ref().ok();
    json!({
        "provider": row.execution.provider,
        "precision": row.execution.precision,
        "threads": row.layout.threads,
        "sessions": row.layout.sessions,
        "max_batch": row.layout.max_batch,
        "alone_ms": figures.map(|figures| figures.alone.as_secs_f64() * 1e3),
        "pictures_per_second": figures.map(|figures| figures.per_second),
        "cosine": figures.map(|figures| figures.similarity),
        "gemm_peak_gflops": figures.map(|figures| figures.peak / 1e9),
        "share_of_peak": figures.and_then(|figures| Some(figures.per_second * flop? / figures.peak)),
        "error": row.outcome.as_ref().err(),
    })
}

/// Sets the keys of `best` and leaves the rest of the file unchanged, including comments.
fn write(file: &Path, best: &BenchRow) -> anyhow::Result<()> {
    let text = match std::fs::read_to_string(file) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", file.display())),
    };
    let mut document: DocumentMut =
        text.parse().with_context(|| format!("{} is not valid TOML", file.display()))?;
    let model = document.entry("model").or_insert_with(|| Item::Table(Table::new()));
    let model = model
        .as_table_mut()
        .with_context(|| format!("`model` in {} is not a table", file.display()))?;
    let number = |number: usize| value(number as i64);
    model["provider"] = value(best.execution.provider.to_string());
    model["precision"] = value(best.execution.precision.to_string());
    model["threads"] = number(best.layout.threads);
    model["sessions"] = number(best.layout.sessions);
    model["max_batch"] = number(best.layout.max_batch);
    std::fs::write(file, document.to_string())
        .with_context(|| format!("cannot write {}", file.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::Precision;
    use whereabouts_vision::{BenchFigures, Execution, Provider};

    fn row(
        precision: Precision,
        sessions: usize,
        ms: u64,
        per_second: f64,
        similarity: f32,
    ) -> BenchRow {
        BenchRow {
            execution: Execution { provider: Provider::OpenVino, precision },
            layout: Layout { threads: 2, sessions, max_batch: 4 },
            outcome: Ok(BenchFigures {
                alone: Duration::from_millis(ms),
                per_second,
                similarity,
                peak: 1e12,
            }),
        }
    }

    #[test]
    fn the_best_row_is_correct_and_has_the_lowest_latency_near_the_highest_throughput() {
        let rows = [
            row(Precision::Full, 1, 40, 25.0, 1.0),
            row(Precision::Bf16, 1, 20, 48.5, 0.9999),
            row(Precision::Bf16, 2, 22, 50.0, 0.9999),
            row(Precision::Bf16, 2, 10, 90.0, 0.99),
        ];
        assert_eq!(best(&rows), Some(&rows[1]));
        assert_eq!(best(&rows[3..]), None);
    }

    #[test]
    fn settings_are_written_and_the_rest_of_the_file_is_unchanged() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("whereabouts.toml");
        let best = row(Precision::Bf16, 2, 22, 50.0, 1.0);
        std::fs::write(&file, "# ours\n[model]\nname = \"xfeat\" # built in\nsessions = 1\n")
            .unwrap();
        write(&file, &best).unwrap();
        let text = std::fs::read_to_string(&file).unwrap();
        for part in ["# ours", "\"xfeat\" # built in", "sessions = 2", "precision = \"bf16\""] {
            assert!(text.contains(part), "{text}");
        }
        let config =
            whereabouts_server::config::Config::load(Some(&file), &Default::default()).unwrap();
        assert_eq!((config.model.sessions, config.model.max_batch), (2, 4));
        std::fs::remove_file(&file).unwrap();
        write(&file, &best).unwrap();
        assert!(std::fs::read_to_string(&file).unwrap().starts_with("[model]"));
    }
}
