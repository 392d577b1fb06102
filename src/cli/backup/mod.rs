//! `whereabouts backup`: saves maps of a server to one file, over HTTP.

mod save;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};

use self::save::Backup;
use super::client::{Client, ServerArg, segment};
use super::progress::ProgressMeter;
use whereabouts_api::MapState;
use whereabouts_archive::{ArchivedMap, Manifest, Resumed, Writer, partial_path};
use whereabouts_core::MapName;

/// Save maps of a server to one file, with their descriptors and images
///
/// The file is a tar archive with a manifest and checksums. It is written as FILE.partial and renamed when it
/// is complete; to resume an interrupted backup, run the same command again. `whereabouts restore` loads the
/// file into this or another server.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// File to write
    file: PathBuf,
    /// Save only this map; repeat the flag for more
    #[arg(long = "map", value_name = "NAME")]
    maps: Vec<MapName>,
    /// Start over, even if an interrupted backup could be resumed
    #[arg(long, visible_alias = "anew")]
    restart: bool,
    /// Number of images to fetch concurrently
    #[arg(long, value_name = "N", default_value_t = 8)]
    #[arg(value_parser = clap::value_parser!(u16).range(1..=64))]
    concurrency: u16,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

#[derive(Debug, Serialize)]
struct BackupReport {
    file: PathBuf,
    bytes: u64,
    images: usize,
    maps: Vec<ArchivedMap>,
    /// Images taken over from an interrupted backup.
    continued: usize,
    /// Maps that were deleted during the backup.
    gone: Vec<MapName>,
    seconds: f64,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let start = Instant::now();
    if args.file.exists() {
        bail!("{} already exists; choose another name or remove it", args.file.display());
    }
    let client = args.server.client()?;
    let states = map_states(&client, &args.maps).await?;
    let names: Vec<MapName> = states.iter().map(|map| map.name.clone()).collect();
    let (writer, resumed) = open_writer(&args, &names)?;
    let continued = resumed.maps.iter().map(|map| map.images).sum();
    let total = states.iter().map(|map| map.images).sum();
    let progress = ProgressMeter::new("images", total);
    progress.set(continued, total);
    let mut backup =
        Backup { client, writer, progress, concurrency: usize::from(args.concurrency) };
    let (maps, gone) = backup.save_maps(&names, resumed).await.with_context(|| {
        format!(
            "the backup is incomplete; {} has what was saved so far, run the same command again to resume",
            partial_path(&args.file).display()
        )
    })?;
    backup.progress.finish();
    backup.writer.finish(maps.clone())?;
    let report = BackupReport {
        bytes: std::fs::metadata(&args.file).map_or(0, |file| file.len()),
        file: args.file,
        images: maps.iter().map(|map| map.images).sum(),
        maps,
        continued,
        gone,
        seconds: start.elapsed().as_secs_f64(),
    };
    print(&report, args.json)
}

/// Fetches the maps to save, sorted by name; all maps if `names` is empty.
async fn map_states(client: &Client, names: &[MapName]) -> anyhow::Result<Vec<MapState>> {
    #[derive(Deserialize)]
    struct List {
        maps: Vec<MapState>,
    }
    let mut states = Vec::new();
    if names.is_empty() {
        states = client.json::<List>(client.get("/maps")).await?.maps;
    }
    for name in names {
        states.push(client.json(client.get(&map_path(name))).await?);
    }
    if states.is_empty() {
        bail!("the server has no maps to save; create one with `whereabouts index`");
    }
    states.sort_by(|a: &MapState, b| a.name.cmp(&b.name));
    states.dedup_by(|a, b| a.name == b.name);
    Ok(states)
}

/// Resumes the interrupted backup of the same maps, if there is one, or begins a new file.
fn open_writer(args: &Args, names: &[MapName]) -> anyhow::Result<(Writer, Resumed)> {
    let partial = partial_path(&args.file);
    if !args.restart
        && let Some((writer, manifest, resumed)) = Writer::resume(&args.file, names)?
    {
        let images: usize = resumed.maps.iter().map(|map| map.images).sum();
        eprintln!(
            "resuming the backup of {}, which has {images} images (--restart starts over)",
            manifest.created_at
        );
        return Ok((writer, resumed));
    }
    if partial.exists() {
        let reason =
            if args.restart { "--restart was given" } else { "it has other maps or is unreadable" };
        eprintln!("overwriting {}: {reason}", partial.display());
    }
    Ok((Writer::begin(&args.file, &Manifest::new(names.to_vec()))?, Resumed::default()))
}

fn map_path(map: &MapName) -> String {
    format!("/maps/{}", segment(map.as_str()))
}

/// Prints the report. Images that could not be saved are an error.
fn print(report: &BackupReport, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(report)?);
    } else {
        for map in &report.maps {
            println!("{}: {} images", map.name, map.images);
        }
        println!(
            "{}: {} images in {} maps, {:.1} MB, {:.1} s",
            report.file.display(),
            report.images,
            report.maps.len(),
            report.bytes as f64 / 1e6,
            report.seconds
        );
    }
    match report.maps.iter().map(|map| map.left_out.len()).sum() {
        0 => Ok(()),
        images => bail!(
            "{images} images could not be saved; {} has all others and can be restored. To find the cause, \
             stop the server and run `whereabouts doctor --deep` on its data folder",
            report.file.display()
        ),
    }
}
