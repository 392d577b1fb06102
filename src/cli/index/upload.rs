//! Uploads a folder of images in batches.

use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, ensure};
use bytes::Bytes;
use futures_util::StreamExt;
use reqwest::multipart::{Form, Part};
use uuid::Uuid;

use super::super::client::{Client, MAX_ATTEMPTS, MAX_PAUSE};
use super::super::message;
use super::super::progress::ProgressMeter;
use super::account::{Entry, FailedImage, IndexReport, Outcome, PoseOrigin};
use super::{Args, map};
use whereabouts_api::{BatchAnswer, BatchOutcome, BatchProblem, BatchResult};
use whereabouts_api::{ErrorKind, ImageMeta};
use whereabouts_core::{Digest, ImageField, ImageId, MediaType, Recording};
use whereabouts_eval::{Folder, FolderPoses, FoundPose, PictureFile, PoseSource};

/// Images in one request. Several requests at a time keep the server busy while one of them completes.
const BATCH_IMAGES: usize = 16;

/// Bytes of image files in one request; a larger file is sent alone.
const BATCH_BYTES: u64 = 32 << 20;

/// Timeout of one request, enough for a model that takes a minute per image.
const BATCH_TIMEOUT: Duration = Duration::from_secs(1800);

/// Adds a folder to a map. An image that cannot be added is in the report; the others are added all the same.
pub async fn add_folder(client: &Client, dir: &Path, args: &Args) -> anyhow::Result<IndexReport> {
    let folder = Folder::read(dir)?;
    let mut poses = FolderPoses::read(&folder, args.poses.as_deref())?;
    let path = map::prepare(client, args, &folder, &mut poses).await?;

    let start = Instant::now();
    let progress = ProgressMeter::new("images", folder.pictures.len());
    let places = places(&folder.pictures);
    let uploader = Uploader { client, path: format!("{path}/images:batch"), poses: &poses, places };
    let mut uploads = futures_util::stream::iter(batches(folder.pictures.clone()))
        .map(|batch| uploader.upload(batch))
        .buffer_unordered(usize::from(args.concurrency));
    let mut entries: HashMap<ImageId, Entry> = HashMap::with_capacity(folder.pictures.len());
    let mut failed = Vec::new();
    while let Some(batch) = uploads.next().await {
        for (picture, result) in batch {
            let entry = match result {
                Ok(uploaded) => uploaded.entry(&picture.id),
                Err(error) => {
                    let error = message(&error);
                    progress.println(&format!("{}: {error}", picture.file.display()));
                    failed.push(FailedImage { file: picture.file, error: error.clone() });
                    Entry {
                        file: picture.id.to_string(),
                        outcome: Outcome::Failed,
                        pose: None,
                        changed: Vec::new(),
                        why: Some(error),
                        warnings: Vec::new(),
                    }
                }
            };
            entries.insert(picture.id, entry);
            progress.step();
        }
    }
    progress.finish();
    failed.sort_by(|a, b| a.file.cmp(&b.file));
    let account =
        folder.pictures.iter().filter_map(|picture| entries.remove(&picture.id)).collect();
    let (rows, seconds) = (poses.account().cloned(), start.elapsed().as_secs_f64());
    Ok(IndexReport::new(args.map.clone(), account, failed, folder.skipped, rows, seconds))
}

/// The places of pictures in the order of their names. Batches are sent side by side, and arrive in any order. The
/// same pictures are always the same recording, so that a folder may be sent again.
fn places(pictures: &[PictureFile]) -> HashMap<ImageId, Recording> {
    let names: Vec<&str> = pictures.iter().map(|picture| picture.id.as_str()).collect();
    let digest = Digest::of(names.join("\n").as_bytes());
    let id = digest.as_bytes().first_chunk().copied().map(Uuid::from_bytes).unwrap_or_default();
    let numbers = 0..u32::MAX;
    let places = pictures.iter().zip(numbers);
    places.map(|(picture, number)| (picture.id.clone(), Recording { id, number })).collect()
}

fn batches(files: Vec<PictureFile>) -> Vec<Vec<PictureFile>> {
    let (mut batches, mut bytes): (Vec<Vec<PictureFile>>, u64) = (Vec::new(), 0);
    for picture in files {
        // A file that cannot be read is reported when it is to be sent.
        let size = picture.file.metadata().map_or(0, |metadata| metadata.len());
        match batches.last_mut() {
            Some(batch) if batch.len() < BATCH_IMAGES && bytes + size <= BATCH_BYTES => {
                bytes += size;
                batch.push(picture);
            }
            _ => {
                bytes = size;
                batches.push(vec![picture]);
            }
        }
    }
    batches
}

/// An image that the server has stored, now or before.
struct Uploaded {
    is_new: bool,
    changed: Vec<ImageField>,
    pose: Option<PoseOrigin>,
    warnings: Vec<String>,
}

impl Uploaded {
    fn entry(self, id: &ImageId) -> Entry {
        let Self { is_new, changed, pose, warnings } = self;
        let outcome = match (is_new, changed.is_empty()) {
            (true, _) => Outcome::Added,
            (false, true) => Outcome::Present,
            (false, false) => Outcome::Changed,
        };
        Entry { file: id.to_string(), outcome, pose, changed, why: None, warnings }
    }
}

/// An image that was read and is to be sent.
struct PendingImage {
    picture: PictureFile,
    bytes: Bytes,
    media_type: Option<MediaType>,
    meta: String,
    source: Option<PoseSource>,
    warnings: Vec<String>,
}

struct Uploader<'a> {
    client: &'a Client,
    path: String,
    poses: &'a FolderPoses,
    /// The place of each picture in the recording that the folder is.
    places: HashMap<ImageId, Recording>,
}

impl Uploader<'_> {
    /// Uploads a batch. Images that the server rejects because it is overloaded are sent again after the pause
    /// that it asks for.
    async fn upload(
        &self,
        batch: Vec<PictureFile>,
    ) -> Vec<(PictureFile, anyhow::Result<Uploaded>)> {
        let (mut pending, mut done) = (Vec::new(), Vec::new());
        for picture in batch {
            match self.read(&picture).await {
                Ok(image) => pending.push(image),
                Err(error) => done.push((picture, Err(error))),
            }
        }
        for retries_left in (0..MAX_ATTEMPTS).rev() {
            if pending.is_empty() {
                return done;
            }
            let answer = match self.post(&pending).await {
                Ok(answer) => answer,
                Err(error) => {
                    let error = message(&error);
                    let fail = |image: PendingImage| (image.picture, Err(anyhow!("{error}")));
                    done.extend(pending.into_iter().map(fail));
                    return done;
                }
            };
            let mut pause = None;
            let mut overloaded = Vec::new();
            for (image, result) in pending.into_iter().zip(answer.results) {
                let BatchResult { outcome, pose, changed, problem, warnings, .. } = result;
                match problem {
                    None => {
                        let uploaded = Uploaded {
                            is_new: outcome == BatchOutcome::Stored,
                            changed,
                            pose: PoseOrigin::new(image.source, pose.is_some()),
                            warnings: united(image.warnings, warnings),
                        };
                        done.push((image.picture, Ok(uploaded)));
                    }
                    Some(BatchProblem { kind, retry_after_s, .. })
                        if kind == ErrorKind::Overloaded.word() && retries_left > 0 =>
                    {
                        let requested = Duration::try_from_secs_f64(retry_after_s.unwrap_or(1.0));
                        pause = pause.max(requested.ok());
                        overloaded.push(image);
                    }
                    Some(problem) => done.push((image.picture, Err(anyhow!("{}", problem.detail)))),
                }
            }
            if let Some(pause) = pause {
                tokio::time::sleep(pause.min(MAX_PAUSE)).await;
            }
            pending = overloaded;
        }
        done
    }

    async fn read(&self, picture: &PictureFile) -> anyhow::Result<PendingImage> {
        let bytes: Bytes =
            tokio::fs::read(&picture.file).await.context("cannot read the file")?.into();
        ensure!(!bytes.is_empty(), "the file is empty");
        let media_type = MediaType::sniff(&bytes);
        let FoundPose { pose, source, captured_at, tags, warnings } =
            self.poses.find(&picture.id, &bytes);
        let meta = ImageMeta {
            id: Some(picture.id.to_string()),
            pose: pose.map(Into::into),
            captured_at,
            tags,
            recording: self.places.get(&picture.id).copied(),
        };
        let meta = serde_json::to_string(&meta)?;
        Ok(PendingImage { picture: picture.clone(), bytes, media_type, meta, source, warnings })
    }

    async fn post(&self, images: &[PendingImage]) -> anyhow::Result<BatchAnswer> {
        let request = || {
            let mut form = Form::new();
            for image in images {
                let part = Part::stream(image.bytes.clone());
                form = form
                    .text("meta", image.meta.clone())
                    .part("image", part.mime_str(content_type(image.media_type))?);
            }
            Ok(self.client.post(&self.path).timeout(BATCH_TIMEOUT).multipart(form))
        };
        let response = self.client.send_with_retries(request).await?;
        let answer: BatchAnswer =
            response.json().await.context("the server's answer is not the expected JSON")?;
        ensure!(
            answer.results.len() == images.len(),
            "the server answered for {} of {} images",
            answer.results.len(),
            images.len()
        );
        Ok(answer)
    }
}

/// The `Content-Type` of a picture; the server decides about bytes of an unknown format.
fn content_type(media_type: Option<MediaType>) -> &'static str {
    media_type.map_or("application/octet-stream", MediaType::as_str)
}

/// The warnings of both sides, each once.
fn united(mut ours: Vec<String>, of_server: Vec<String>) -> Vec<String> {
    let new: Vec<String> = of_server.into_iter().filter(|text| !ours.contains(text)).collect();
    ours.extend(new);
    ours
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_are_bounded_in_images_and_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let picture = |name: String, bytes: u64| {
            let file = dir.path().join(&name);
            std::fs::File::create(&file).unwrap().set_len(bytes).unwrap();
            PictureFile { file, id: name.parse().unwrap() }
        };
        let mut files: Vec<_> = (0..20).map(|i| picture(format!("small-{i:02}"), 10)).collect();
        files.push(picture("large".into(), BATCH_BYTES + 1));
        files.push(picture("last".into(), 1));
        let sizes: Vec<_> = batches(files).iter().map(Vec::len).collect();
        assert_eq!(sizes, [16, 4, 1, 1]);
    }
}
