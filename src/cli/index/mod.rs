//! `whereabouts index`: a folder of images into a map, over HTTP; or a map to another model.

mod reindex;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, bail};
use futures_util::StreamExt;
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde::Serialize;

use super::client::{Client, ServerArg, segment};
use super::progress::Progress;
use crate::domain::{DescriptorKind, Frame, MapName, MediaType, Scene};
use crate::evaluate::{PictureFile, PoseSource, pictures};
use crate::service::{ImageMeta, MapChange};

/// Poses come from a CSV file (--poses, or poses.csv in the folder), from file names of the form
/// @easting@northing@..., or from EXIF GPS. It is safe to run this again: what is there already is
/// left as it is.
///
/// With --reindex, the server makes new descriptors of all images that the map has, with another
/// model or with the one installed now. The map answers with the old ones until that is done.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder; folders in it are searched too
    #[arg(required_unless_present = "reindex")]
    pub dir: Option<PathBuf>,
    /// Make the descriptors of all images of the map anew
    #[arg(long, conflicts_with_all = ["dir", "poses", "scene", "frame", "concurrency"])]
    pub reindex: bool,
    /// The map; made if it is not there
    #[arg(long)]
    pub map: MapName,
    /// A CSV file with a header: file, and lat,lon[,alt,heading] or x,y[,z,qx,qy,qz,qw]
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// What the map shows
    #[arg(long)]
    pub scene: Option<Scene>,
    /// The model of a new map; with --reindex, the one that makes the descriptors anew
    #[arg(long, value_name = "NAME")]
    pub model: Option<String>,
    /// The descriptor of a new map; with --reindex, the one to make
    #[arg(long)]
    pub descriptor: Option<DescriptorKind>,
    /// The frame of a new map; otherwise it follows from the poses
    #[arg(long)]
    pub frame: Option<Frame>,
    /// Images sent side by side
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=64))]
    pub concurrency: u16,
    /// Print the outcome as JSON
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub server: ServerArg,
}

/// What became of the folder.
#[derive(Debug, Serialize)]
pub struct Outcome {
    map: MapName,
    /// Images in the folder.
    pub images: usize,
    added: usize,
    present: usize,
    without_pose: usize,
    failed: Vec<Failure>,
    /// How long it took.
    pub seconds: f64,
    images_per_second: f64,
}

#[derive(Debug, Serialize)]
struct Failure {
    file: PathBuf,
    error: String,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = Client::new(&args.server)?;
    match &args.dir {
        Some(dir) => report(&add_folder(&client, dir, &args).await?, args.json),
        None => reindex::run(&client, &args).await,
    }
}

/// Adds a folder to a map; what became of each image is in the outcome.
pub async fn add_folder(client: &Client, dir: &Path, args: &Args) -> anyhow::Result<Outcome> {
    let files = pictures(dir)?;
    let source = Arc::new(PoseSource::find(dir, args.poses.as_deref(), &files)?);
    let change = MapChange {
        model: args.model.clone(),
        scene: args.scene,
        descriptor: args.descriptor,
        frame: args.frame.or(source.frame()),
        ..MapChange::default()
    };
    let path = format!("/maps/{}", segment(args.map.as_str()));
    client.send(client.put(&path).json(&change)).await?;

    let start = Instant::now();
    let progress = Progress::new("images", files.len());
    let path = Arc::new(format!("{path}/images"));
    let mut sent = futures_util::stream::iter(files.iter().cloned())
        .map(|file| {
            let (client, path, source) = (client.clone(), Arc::clone(&path), Arc::clone(&source));
            async move {
                let result = send(&client, &path, &file, &source).await;
                (file.file, result)
            }
        })
        .buffer_unordered(usize::from(args.concurrency));
    let mut outcome = Outcome {
        map: args.map.clone(),
        images: files.len(),
        added: 0,
        present: 0,
        without_pose: 0,
        failed: Vec::new(),
        seconds: 0.0,
        images_per_second: 0.0,
    };
    while let Some((file, result)) = sent.next().await {
        match result {
            Ok(Sent { new, posed }) => {
                outcome.added += usize::from(new);
                outcome.present += usize::from(!new);
                outcome.without_pose += usize::from(!posed);
            }
            Err(error) => {
                progress.say(&format!("{}: {error:#}", file.display()));
                outcome.failed.push(Failure { file, error: format!("{error:#}") });
            }
        }
        progress.step();
    }
    progress.end();
    outcome.seconds = start.elapsed().as_secs_f64();
    outcome.images_per_second = files.len() as f64 / outcome.seconds.max(1e-9);
    Ok(outcome)
}

/// Prints the outcome; an image that was not added is an error.
pub fn report(outcome: &Outcome, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(outcome)?);
    } else {
        println!(
            "{}: {} added, {} there already, {} failed, {} without a pose; {:.1} s, {:.1} images/s",
            outcome.map,
            outcome.added,
            outcome.present,
            outcome.failed.len(),
            outcome.without_pose,
            outcome.seconds,
            outcome.images_per_second
        );
    }
    if !outcome.failed.is_empty() {
        bail!("{} of {} images were not added", outcome.failed.len(), outcome.images);
    }
    Ok(())
}

struct Sent {
    new: bool,
    posed: bool,
}

async fn send(
    client: &Client,
    path: &str,
    picture: &PictureFile,
    source: &PoseSource,
) -> anyhow::Result<Sent> {
    let bytes: bytes::Bytes =
        tokio::fs::read(&picture.file).await.context("cannot be read")?.into();
    let media_type = MediaType::sniff(&bytes).context("is not a JPEG, PNG or WebP picture")?;
    let pose = source.pose(picture.id.as_str(), &bytes)?;
    let posed = pose.is_some();
    let meta = ImageMeta {
        id: Some(picture.id.to_string()),
        pose: pose.map(serde_json::to_value).transpose()?,
        ..ImageMeta::default()
    };
    let meta = serde_json::to_string(&meta)?;
    let response = client
        .send_patiently(|| {
            let part = Part::stream(bytes.clone()).mime_str(media_type.as_str())?;
            let form = Form::new().part("image", part).text("meta", meta.clone());
            Ok(client.post(path).multipart(form))
        })
        .await?;
    Ok(Sent { new: response.status() == StatusCode::CREATED, posed })
}
