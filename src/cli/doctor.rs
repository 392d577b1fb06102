//! `whereabouts doctor`: examines the data folder of a stopped server.

use std::path::PathBuf;

use anyhow::bail;
use serde::Serialize;

use whereabouts_server::config::{Config, Overrides};
use whereabouts_store::embedded::{Compacted, Examination, MapReport, Report, compact, examine};

/// Check a data folder for problems
///
/// Stop the server first. The exit code is 0 if nothing is wrong and 1 otherwise; each finding says what to
/// do about it.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration file that names the data folder
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Data folder
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Also read every image file and verify its SHA-256
    #[arg(long)]
    deep: bool,
    /// Repair what can be repaired without losing anything: unused files, derived files and references
    #[arg(long)]
    repair: bool,
    /// Rewrite the database to make its files as small as possible; needs disk space for both copies
    #[arg(long)]
    compact: bool,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct DoctorReport {
    #[serde(flatten)]
    examination: Report,
    compacted: Option<Compacted>,
}

pub fn run(args: Args) -> anyhow::Result<()> {
    let flags = Overrides::default().data(args.data);
    let dir = Config::load(args.config.as_deref(), &flags)?.data.dir;
    let compacted = if args.compact { Some(compact(&dir)?) } else { None };
    let options = Examination { deep: args.deep, repair: args.repair };
    let report = DoctorReport { examination: examine(&dir, options)?, compacted };
    match args.json {
        true => println!("{}", serde_json::to_string(&report)?),
        false => print(&report),
    }
    match report.examination.problems() {
        0 => Ok(()),
        1 => bail!("found 1 problem in {}; the report above says what to do", dir.display()),
        problems => {
            bail!(
                "found {problems} problems in {}; the report above says what to do",
                dir.display()
            )
        }
    }
}

fn print(DoctorReport { examination, compacted }: &DoctorReport) {
    let version = examination.version.map_or("none".to_owned(), |version| version.to_string());
    println!("folder       {}, version {version}", examination.folder.display());
    if let Some(Compacted { bytes_before, bytes_after }) = compacted {
        println!(
            "compacted    database from {} to {}",
            format_bytes(*bytes_before),
            format_bytes(*bytes_after)
        );
    }
    let sizes = &examination.sizes;
    let parts = [
        ("database", sizes.db),
        ("descriptors", sizes.descriptors),
        ("graphs", sizes.graphs),
        ("images", sizes.images),
        ("copies", sizes.copies),
        ("other", sizes.other),
        ("total", sizes.total()),
        ("free", sizes.free),
    ];
    for (part, bytes) in parts {
        println!("{part:12} {:>10}", format_bytes(bytes));
    }
    examination.maps.iter().for_each(print_map);
    if !examination.jobs.is_empty() {
        let jobs: Vec<_> =
            examination.jobs.iter().map(|(state, count)| format!("{count} {state}")).collect();
        println!("jobs         {}", jobs.join(", "));
    }
    for finding in &examination.findings {
        let kind = match (finding.repaired, finding.is_problem) {
            (true, _) => "repaired",
            (false, true) => "problem",
            (false, false) => "note",
        };
        println!("\n{kind}: {}\n  {}", finding.what, finding.advice);
    }
    if examination.findings.is_empty() {
        println!("\nno problems found");
    }
}

fn print_map(map: &MapReport) {
    let per_image = |bytes: u64| format_bytes(bytes / map.images.max(1) as u64);
    println!(
        "map          {}: {} images, model {} ({} dimensions); per image: descriptor {}, graph {}, file {}",
        map.name,
        map.images,
        map.model,
        map.dim,
        per_image(map.descriptor_bytes),
        per_image(map.graph_bytes),
        per_image(map.picture_bytes),
    );
}

fn format_bytes(bytes: u64) -> String {
    match bytes as f64 {
        bytes if bytes < 1e3 => format!("{bytes} B"),
        bytes if bytes < 1e6 => format!("{:.1} kB", bytes / 1e3),
        bytes if bytes < 1e9 => format!("{:.1} MB", bytes / 1e6),
        bytes => format!("{:.1} GB", bytes / 1e9),
    }
}
