//! `whereabouts doctor`: looks into a data folder that no server uses.

use std::path::PathBuf;

use anyhow::bail;
use serde::Serialize;

use whereabouts_server::config::{Config, Overrides};
use whereabouts_store::embedded::{Compacted, Examination, MapReport, Report, compact, examine};

/// Stop the server first. Exit code 0: nothing is wrong; 1: something is, and each line says what to do.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A configuration file, for the folder that it names
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The data folder
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Read every picture too, and compare its SHA-256
    #[arg(long)]
    deep: bool,
    /// Put right what can be without losing anything: files that nothing needs, derived files,
    /// references
    #[arg(long)]
    repair: bool,
    /// Write the database anew, which makes its files as small as can be; needs room for both
    #[arg(long)]
    compact: bool,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Outcome {
    #[serde(flatten)]
    report: Report,
    compacted: Option<Compacted>,
}

pub fn run(args: Args) -> anyhow::Result<()> {
    let flags = Overrides::default().data(args.data);
    let dir = Config::load(args.config.as_deref(), &flags)?.data.dir;
    let compacted = if args.compact { Some(compact(&dir)?) } else { None };
    let how = Examination { deep: args.deep, repair: args.repair };
    let outcome = Outcome { report: examine(&dir, how)?, compacted };
    match args.json {
        true => println!("{}", serde_json::to_string(&outcome)?),
        false => print(&outcome),
    }
    match outcome.report.problems() {
        0 => Ok(()),
        1 => bail!("something is wrong with {}", dir.display()),
        problems => bail!("{problems} things are wrong with {}", dir.display()),
    }
}

fn print(outcome: &Outcome) {
    let Outcome { report, compacted } = outcome;
    let version = report.version.map_or("none".to_owned(), |version| version.to_string());
    println!("folder       {}, version {version}", report.folder.display());
    if let Some(Compacted { bytes_before, bytes_after }) = compacted {
        println!("compacted    database from {} to {}", size(*bytes_before), size(*bytes_after));
    }
    let sizes = &report.sizes;
    let parts = [
        ("database", sizes.db),
        ("descriptors", sizes.descriptors),
        ("graphs", sizes.graphs),
        ("images", sizes.images),
        ("copies", sizes.copies),
        ("other", sizes.other),
        ("all", sizes.total()),
        ("free", sizes.free),
    ];
    for (part, bytes) in parts {
        println!("{part:12} {:>10}", size(bytes));
    }
    report.maps.iter().for_each(print_map);
    if !report.jobs.is_empty() {
        let jobs: Vec<_> = report.jobs.iter().map(|(state, n)| format!("{n} {state}")).collect();
        println!("jobs         {}", jobs.join(", "));
    }
    for finding in &report.findings {
        let kind = match (finding.repaired, finding.is_problem) {
            (true, _) => "repaired",
            (false, true) => "problem",
            (false, false) => "note",
        };
        println!("\n{kind}: {}\n  {}", finding.what, finding.advice);
    }
    if report.findings.is_empty() {
        println!("\nall is in order");
    }
}

fn print_map(map: &MapReport) {
    let each = |bytes: u64| size(bytes / map.images.max(1) as u64);
    println!(
        "map          {}: {} images by {} ({} numbers); each: descriptor {}, graph {}, picture {}",
        map.name,
        map.images,
        map.model,
        map.dim,
        each(map.descriptor_bytes),
        each(map.graph_bytes),
        each(map.picture_bytes),
    );
}

fn size(bytes: u64) -> String {
    match bytes as f64 {
        few if few < 1e3 => format!("{few} B"),
        kilo if kilo < 1e6 => format!("{:.1} kB", kilo / 1e3),
        mega if mega < 1e9 => format!("{:.1} MB", mega / 1e6),
        giga => format!("{:.1} GB", giga / 1e9),
    }
}
