//! `whereabouts index`: adds a folder of images to a map, or computes a map's descriptors again with another
//! model, over HTTP.

mod reindex;
mod upload;

use std::path::PathBuf;

use anyhow::bail;
use serde::Serialize;

pub use self::upload::add_folder;
use super::client::ServerArg;
use whereabouts_core::{CoordinateFrame, DescriptorKind, MapName, Scene};

/// Add a folder of images to a map on a server
///
/// Poses are read from a CSV file (--poses, or poses.csv in the folder), from file names of the form
/// @easting@northing@..., or from EXIF GPS. It is safe to run this again: images that the map already has are
/// skipped.
///
/// With --reindex, the server computes new descriptors for all images of the map, with another model or with
/// the version that is installed now. Until that is done, the map keeps answering with the old ones.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of images; subfolders are included
    #[arg(required_unless_present = "reindex")]
    pub dir: Option<PathBuf>,
    /// Compute new descriptors for all images of the map
    #[arg(long, conflicts_with_all = ["dir", "poses", "scene", "frame", "concurrency"])]
    pub reindex: bool,
    /// Map to add to; created if it does not exist
    #[arg(long)]
    pub map: MapName,
    /// CSV file of poses, with the header file,lat,lon[,alt,heading] or file,x,y[,z,qx,qy,qz,qw]
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// Kind of place that the map shows
    #[arg(long)]
    pub scene: Option<Scene>,
    /// Model of a new map; with --reindex, the model to compute descriptors with
    #[arg(long, value_name = "NAME")]
    pub model: Option<String>,
    /// Descriptor of a new map; with --reindex, the descriptor to compute
    #[arg(long)]
    pub descriptor: Option<DescriptorKind>,
    /// Coordinate frame of a new map [default: the frame of the poses]
    #[arg(long)]
    pub frame: Option<CoordinateFrame>,
    /// Number of concurrent requests, of up to 16 images each
    #[arg(long, value_name = "N", default_value_t = 2)]
    #[arg(value_parser = clap::value_parser!(u16).range(1..=64))]
    pub concurrency: u16,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub server: ServerArg,
}

/// What was added to the map, and what could not be.
#[derive(Debug, Serialize)]
pub struct IndexReport {
    map: MapName,
    /// Images in the folder.
    pub images: usize,
    added: usize,
    present: usize,
    without_pose: usize,
    /// Images that the server took with a warning.
    damaged: usize,
    failed: Vec<FailedImage>,
    /// Duration of the upload.
    pub seconds: f64,
    images_per_second: f64,
}

#[derive(Debug, Serialize)]
struct FailedImage {
    file: PathBuf,
    error: String,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    match &args.dir {
        Some(dir) => print(&add_folder(&client, dir, &args).await?, args.json),
        None => reindex::run(&client, &args).await,
    }
}

/// Prints the report. Images that were not added are an error.
fn print(report: &IndexReport, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(report)?);
    } else {
        println!(
            "{}: {} added, {} already present, {} failed, {} without a pose; {:.1} s, {:.1} images/s",
            report.map,
            report.added,
            report.present,
            report.failed.len(),
            report.without_pose,
            report.seconds,
            report.images_per_second
        );
        if report.damaged > 0 {
            println!("{} images are damaged; see the warnings above", report.damaged);
        }
    }
    if !report.failed.is_empty() {
        bail!(
            "{} of {} images were not added; repair or remove them, then run the same command again",
            report.failed.len(),
            report.images
        );
    }
    Ok(())
}
