//! `whereabouts index`: adds a folder of images to a map, or computes a map's descriptors again with another
//! model, over HTTP.

mod account;
mod map;
mod reindex;
mod upload;

use std::path::PathBuf;

pub use self::account::IndexReport;
pub use self::upload::add_folder;
use super::client::ServerArg;
use whereabouts_api::VocabularyChoice;
use whereabouts_core::{CoordinateFrame, DescriptorKind, MapName, Scene};

/// Add a folder of images to a map on a server
///
/// The pose of each image is taken from the first source that has one: a table (--poses, or poses.csv in the
/// folder), a file NAME.json next to the image NAME, a file name of the form @easting@northing@..., or EXIF GPS.
/// It is safe to run this again: images that the map already has stay, and get the pose, time and tags that the
/// folder has for them now.
///
/// The result accounts for every picture (added, already present, changed, skipped, failed) and for every row of
/// the table. The exit code is 1 if a picture was not added.
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
    /// Table of poses (CSV), with the header file,lat,lon[,alt,heading] or file,x,y[,z,qx,qy,qz,qw]
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// Kind of place that the map shows
    #[arg(long)]
    pub scene: Option<Scene>,
    /// Model of a new map; with --reindex, the model to compute descriptors with
    #[arg(long, value_name = "NAME")]
    pub model: Option<String>,
    /// Descriptor of a new map, one that the model has, such as gem [default: the model's default]; with --reindex,
    /// the descriptor to compute
    #[arg(long, value_name = "KIND")]
    pub descriptor: Option<DescriptorKind>,
    /// Vocabulary to compute the descriptors with: own fits one on the images of the map, shipped is that of the model
    #[arg(long, value_name = "own|shipped", requires = "reindex", value_parser = vocabulary)]
    pub vocabulary: Option<VocabularyChoice>,
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

fn vocabulary(text: &str) -> Result<VocabularyChoice, String> {
    match text {
        "own" => Ok(VocabularyChoice::Own),
        "shipped" => Ok(VocabularyChoice::Shipped),
        _ => Err("expected own or shipped".to_owned()),
    }
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    match &args.dir {
        Some(dir) => add_folder(&client, dir, &args).await?.print(args.json),
        None => reindex::run(&client, &args).await,
    }
}
