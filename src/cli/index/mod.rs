//! `whereabouts index`: a folder of images into a map, over HTTP; or a map to another model.

mod reindex;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use bytes::Bytes;
use futures_util::StreamExt;
use reqwest::multipart::{Form, Part};
use serde::Serialize;

use super::client::{Client, MAX_ATTEMPTS, MAX_PAUSE, ServerArg, segment};
use super::progress::Progress;
use whereabouts_api::{BatchAnswer, BatchOutcome, BatchProblem, BatchResult};
use whereabouts_api::{ErrorKind, ImageMeta, MapChange};
use whereabouts_core::{CoordinateFrame, DescriptorKind, MapName, MediaType, Scene};
use whereabouts_eval::{PictureFile, PoseSource, pictures};

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
    pub frame: Option<CoordinateFrame>,
    /// Requests side by side, each with up to 16 images
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=64))]
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
    let client = args.server.client()?;
    match &args.dir {
        Some(dir) => report(&add_folder(&client, dir, &args).await?, args.json),
        None => reindex::run(&client, &args).await,
    }
}

/// Adds a folder to a map; what became of each image is in the outcome.
pub async fn add_folder(client: &Client, dir: &Path, args: &Args) -> anyhow::Result<Outcome> {
    let files = pictures(dir)?;
    let source = PoseSource::find(dir, args.poses.as_deref(), &files)?;
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
    let sender = Sender { client, path: format!("{path}/images:batch"), source: &source };
    let mut sent = futures_util::stream::iter(groups(files.clone()))
        .map(|group| sender.send(group))
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
    while let Some(group) = sent.next().await {
        for (file, result) in group {
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
    }
    progress.end();
    outcome.failed.sort_by(|a, b| a.file.cmp(&b.file));
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

/// Images of one request; several requests side by side keep the server busy while one ends.
const GROUP: usize = 16;

/// The largest files of a group, in bytes, unless it is a single one.
const GROUP_BYTES: u64 = 32 << 20;

/// The longest that a group may take, by a model that needs a minute for an image.
const LONGEST: Duration = Duration::from_secs(1800);

/// The pictures in groups.
fn groups(files: Vec<PictureFile>) -> Vec<Vec<PictureFile>> {
    let (mut groups, mut bytes): (Vec<Vec<PictureFile>>, u64) = (Vec::new(), 0);
    for picture in files {
        // What cannot be read is said when it is to be sent.
        let size = picture.file.metadata().map_or(0, |about| about.len());
        match groups.last_mut() {
            Some(group) if group.len() < GROUP && bytes + size <= GROUP_BYTES => {
                bytes += size;
                group.push(picture);
            }
            _ => {
                bytes = size;
                groups.push(vec![picture]);
            }
        }
    }
    groups
}

struct Sent {
    new: bool,
    posed: bool,
}

/// A picture that was read.
struct Read {
    file: PathBuf,
    bytes: Bytes,
    media_type: MediaType,
    meta: String,
    posed: bool,
}

struct Sender<'a> {
    client: &'a Client,
    path: String,
    source: &'a PoseSource,
}

impl Sender<'_> {
    /// Sends a group; those that the server has no room for again, after a while.
    async fn send(&self, group: Vec<PictureFile>) -> Vec<(PathBuf, anyhow::Result<Sent>)> {
        let (mut waiting, mut done) = (Vec::new(), Vec::new());
        for picture in group {
            match self.read(&picture).await {
                Ok(read) => waiting.push(read),
                Err(error) => done.push((picture.file, Err(error))),
            }
        }
        for patience in (0..MAX_ATTEMPTS).rev() {
            if waiting.is_empty() {
                return done;
            }
            let answer = match self.post(&waiting).await {
                Ok(answer) => answer,
                Err(error) => {
                    let error = format!("{error:#}");
                    let failed = |read: Read| (read.file, Err(anyhow!("{error}")));
                    done.extend(waiting.into_iter().map(failed));
                    return done;
                }
            };
            let mut pause = None;
            let mut again = Vec::new();
            for (read, BatchResult { outcome, problem, .. }) in
                waiting.into_iter().zip(answer.results)
            {
                let new = outcome == BatchOutcome::Stored;
                match problem {
                    None => done.push((read.file, Ok(Sent { new, posed: read.posed }))),
                    Some(BatchProblem { kind, retry_after_s, .. })
                        if kind == ErrorKind::Overloaded.word() && patience > 0 =>
                    {
                        let wanted = Duration::try_from_secs_f64(retry_after_s.unwrap_or(1.0));
                        pause = pause.max(wanted.ok());
                        again.push(read);
                    }
                    Some(problem) => done.push((read.file, Err(anyhow!("{}", problem.detail)))),
                }
            }
            if let Some(pause) = pause {
                tokio::time::sleep(pause.min(MAX_PAUSE)).await;
            }
            waiting = again;
        }
        done
    }

    async fn read(&self, picture: &PictureFile) -> anyhow::Result<Read> {
        let bytes: Bytes = tokio::fs::read(&picture.file).await.context("cannot be read")?.into();
        let media_type = MediaType::sniff(&bytes).context("is not a JPEG, PNG or WebP picture")?;
        let pose = self.source.pose(picture.id.as_str(), &bytes)?;
        let posed = pose.is_some();
        let meta = ImageMeta {
            id: Some(picture.id.to_string()),
            pose: pose.map(Into::into),
            ..ImageMeta::default()
        };
        let meta = serde_json::to_string(&meta)?;
        Ok(Read { file: picture.file.clone(), bytes, media_type, meta, posed })
    }

    async fn post(&self, pictures: &[Read]) -> anyhow::Result<BatchAnswer> {
        let make = || {
            let mut form = Form::new();
            for picture in pictures {
                let part = Part::stream(picture.bytes.clone());
                form = form
                    .text("meta", picture.meta.clone())
                    .part("image", part.mime_str(picture.media_type.as_str())?);
            }
            Ok(self.client.post(&self.path).timeout(LONGEST).multipart(form))
        };
        let response = self.client.send_with_retries(make).await?;
        let answer: BatchAnswer =
            response.json().await.context("the server's answer is not the JSON expected")?;
        ensure!(
            answer.results.len() == pictures.len(),
            "the server's answer is not about all images"
        );
        Ok(answer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_bounded_in_number_and_size() {
        let dir = tempfile::tempdir().unwrap();
        let picture = |name: String, bytes: u64| {
            let file = dir.path().join(&name);
            std::fs::File::create(&file).unwrap().set_len(bytes).unwrap();
            PictureFile { file, id: name.parse().unwrap() }
        };
        let mut files: Vec<_> = (0..20).map(|i| picture(format!("small-{i:02}"), 10)).collect();
        files.push(picture("large".into(), GROUP_BYTES + 1));
        files.push(picture("last".into(), 1));
        let sizes: Vec<_> = groups(files).iter().map(Vec::len).collect();
        assert_eq!(sizes, [16, 4, 1, 1]);
    }
}
