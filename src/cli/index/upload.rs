//! Uploads a folder of images in batches.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, ensure};
use bytes::Bytes;
use futures_util::StreamExt;
use reqwest::multipart::{Form, Part};

use super::super::client::{Client, MAX_ATTEMPTS, MAX_PAUSE, segment};
use super::super::progress::ProgressMeter;
use super::{Args, FailedImage, IndexReport};
use whereabouts_api::{BatchAnswer, BatchOutcome, BatchProblem, BatchResult};
use whereabouts_api::{ErrorKind, ImageMeta, MapChange};
use whereabouts_core::MediaType;
use whereabouts_eval::{PictureFile, PoseSource, pictures};

/// Images in one request. Several requests at a time keep the server busy while one of them completes.
const BATCH_IMAGES: usize = 16;

/// Bytes of image files in one request; a larger file is sent alone.
const BATCH_BYTES: u64 = 32 << 20;

/// Timeout of one request, enough for a model that takes a minute per image.
const BATCH_TIMEOUT: Duration = Duration::from_secs(1800);

/// Adds a folder to a map. An image that cannot be added is in the report; the others are added all the same.
pub async fn add_folder(client: &Client, dir: &Path, args: &Args) -> anyhow::Result<IndexReport> {
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
    let progress = ProgressMeter::new("images", files.len());
    let uploader = Uploader { client, path: format!("{path}/images:batch"), source: &source };
    let mut uploads = futures_util::stream::iter(batches(files.clone()))
        .map(|batch| uploader.upload(batch))
        .buffer_unordered(usize::from(args.concurrency));
    let mut report = IndexReport {
        map: args.map.clone(),
        images: files.len(),
        added: 0,
        present: 0,
        without_pose: 0,
        damaged: 0,
        failed: Vec::new(),
        seconds: 0.0,
        images_per_second: 0.0,
    };
    while let Some(batch) = uploads.next().await {
        for (file, result) in batch {
            match result {
                Ok(Uploaded { is_new, has_pose, warnings }) => {
                    for warning in &warnings {
                        progress.println(&format!("{}: warning: {warning}", file.display()));
                    }
                    report.damaged += usize::from(!warnings.is_empty());
                    report.added += usize::from(is_new);
                    report.present += usize::from(!is_new);
                    report.without_pose += usize::from(!has_pose);
                }
                Err(error) => {
                    progress.println(&format!("{}: {error:#}", file.display()));
                    report.failed.push(FailedImage { file, error: format!("{error:#}") });
                }
            }
            progress.step();
        }
    }
    progress.finish();
    report.failed.sort_by(|a, b| a.file.cmp(&b.file));
    report.seconds = start.elapsed().as_secs_f64();
    report.images_per_second = files.len() as f64 / report.seconds.max(1e-9);
    Ok(report)
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
    has_pose: bool,
    warnings: Vec<String>,
}

/// An image that was read and is to be sent.
struct PendingImage {
    file: PathBuf,
    bytes: Bytes,
    media_type: Option<MediaType>,
    meta: String,
    has_pose: bool,
}

struct Uploader<'a> {
    client: &'a Client,
    path: String,
    source: &'a PoseSource,
}

impl Uploader<'_> {
    /// Uploads a batch. Images that the server rejects because it is overloaded are sent again after the pause
    /// that it asks for.
    async fn upload(&self, batch: Vec<PictureFile>) -> Vec<(PathBuf, anyhow::Result<Uploaded>)> {
        let (mut pending, mut done) = (Vec::new(), Vec::new());
        for picture in batch {
            match self.read(&picture).await {
                Ok(image) => pending.push(image),
                Err(error) => done.push((picture.file, Err(error))),
            }
        }
        for retries_left in (0..MAX_ATTEMPTS).rev() {
            if pending.is_empty() {
                return done;
            }
            let answer = match self.post(&pending).await {
                Ok(answer) => answer,
                Err(error) => {
                    let error = format!("{error:#}");
                    let fail = |image: PendingImage| (image.file, Err(anyhow!("{error}")));
                    done.extend(pending.into_iter().map(fail));
                    return done;
                }
            };
            let mut pause = None;
            let mut overloaded = Vec::new();
            for (image, BatchResult { outcome, problem, warnings, .. }) in
                pending.into_iter().zip(answer.results)
            {
                let is_new = outcome == BatchOutcome::Stored;
                match problem {
                    None => {
                        let has_pose = image.has_pose;
                        done.push((image.file, Ok(Uploaded { is_new, has_pose, warnings })));
                    }
                    Some(BatchProblem { kind, retry_after_s, .. })
                        if kind == ErrorKind::Overloaded.word() && retries_left > 0 =>
                    {
                        let requested = Duration::try_from_secs_f64(retry_after_s.unwrap_or(1.0));
                        pause = pause.max(requested.ok());
                        overloaded.push(image);
                    }
                    Some(problem) => done.push((image.file, Err(anyhow!("{}", problem.detail)))),
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
        let media_type = MediaType::sniff(&bytes);
        let pose = self.source.pose(picture.id.as_str(), &bytes)?;
        let has_pose = pose.is_some();
        let meta = ImageMeta {
            id: Some(picture.id.to_string()),
            pose: pose.map(Into::into),
            ..ImageMeta::default()
        };
        let meta = serde_json::to_string(&meta)?;
        Ok(PendingImage { file: picture.file.clone(), bytes, media_type, meta, has_pose })
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
