//! Writes maps of a server to an archive, image by image, and starts a map over if it changes meanwhile.

use anyhow::{Context, bail};
use bytes::Bytes;
use futures_util::StreamExt;
use reqwest::StatusCode;

use super::super::client::{Client, explained, segment};
use super::super::progress::ProgressMeter;
use super::map_path;
use whereabouts_api::ExportPage;
use whereabouts_archive::{ArchivedMap, Checkpoint, LeftOut, Resumed, Writer};
use whereabouts_core::{Digest, ExportedImage, Image, ImageId, Map, MapName};

/// Images whose records are fetched with one request.
const PAGE_SIZE: usize = 256;
/// Attempts to save a map that changes while it is saved.
const MAX_ATTEMPTS: usize = 3;

pub struct Backup {
    pub client: Client,
    pub writer: Writer,
    pub progress: ProgressMeter,
    /// Images fetched concurrently.
    pub concurrency: usize,
}

/// How the backup of one map ended.
enum MapOutcome {
    Saved(ArchivedMap),
    /// It was deleted on the server; the archive does not have it.
    Deleted,
}

/// How far one map is saved.
struct MapProgress {
    /// Where the map begins in the archive.
    start: Checkpoint,
    map: Option<Map>,
    images: usize,
    last: Option<ImageId>,
    left_out: Vec<LeftOut>,
}

impl MapProgress {
    fn new(start: Checkpoint) -> Self {
        Self { start, map: None, images: 0, last: None, left_out: Vec::new() }
    }
}

impl Backup {
    /// Saves all maps and returns those saved, and those deleted on the server meanwhile.
    pub async fn save_maps(
        &mut self,
        names: &[MapName],
        mut resumed: Resumed,
    ) -> anyhow::Result<(Vec<ArchivedMap>, Vec<MapName>)> {
        // The last map of an interrupted backup may be incomplete.
        let last = resumed.maps.pop();
        let resume_at = last.as_ref().and_then(|last| names.iter().position(|n| *n == last.name));
        let mut unfinished = last.zip(resumed.map_start).map(|(last, start)| MapProgress {
            start,
            map: resumed.map,
            images: last.images,
            last: resumed.last,
            left_out: last.left_out,
        });
        let (mut saved, mut deleted) = (resumed.maps, Vec::new());
        for name in &names[resume_at.unwrap_or(0)..] {
            let progress =
                unfinished.take().unwrap_or_else(|| MapProgress::new(self.writer.checkpoint()));
            match self.save_map(name, progress).await? {
                MapOutcome::Saved(map) => saved.push(map),
                MapOutcome::Deleted => {
                    self.progress
                        .println(&format!("{name} was deleted during the backup; skipping it"));
                    deleted.push(name.clone());
                }
            }
        }
        Ok((saved, deleted))
    }

    async fn save_map(
        &mut self,
        name: &MapName,
        mut progress: MapProgress,
    ) -> anyhow::Result<MapOutcome> {
        let mut attempt = 1;
        loop {
            let cursor = progress.last.as_ref().map(|id| ("cursor", id.to_string()));
            let query: Vec<_> =
                cursor.into_iter().chain([("limit", PAGE_SIZE.to_string())]).collect();
            let request =
                || Ok(self.client.get(&format!("{}/export", map_path(name))).query(&query));
            let response = self.client.response_with_retries(request).await?;
            if response.status() == StatusCode::NOT_FOUND {
                self.writer.rewind(&progress.start)?;
                return Ok(MapOutcome::Deleted);
            }
            if !response.status().is_success() {
                return Err(explained(response).await);
            }
            let page: ExportPage =
                response.json().await.context("the server's export is not valid")?;
            match &progress.map {
                None => {
                    let vocabulary = match self.vocabulary(name, &page.map).await? {
                        Some(Vocabulary::Is(bytes)) => Some(bytes),
                        // The map was changed since the page was read.
                        Some(Vocabulary::Changed) if attempt < MAX_ATTEMPTS => {
                            attempt += 1;
                            continue;
                        }
                        Some(Vocabulary::Changed) => bail!(
                            "the vocabulary of the map {name} cannot be read; reindex the map, or try again when it \
                             no longer changes"
                        ),
                        None => None,
                    };
                    self.writer.map(&page.map, vocabulary.as_deref())?;
                    progress.map = Some(page.map);
                }
                Some(map) if (map.uid, map.revision) == (page.map.uid, page.map.revision) => {}
                Some(_) if attempt < MAX_ATTEMPTS => {
                    self.progress.println(&format!(
                        "{name} was reindexed or re-created during the backup; saving it from its beginning"
                    ));
                    self.writer.rewind(&progress.start)?;
                    progress = MapProgress::new(progress.start);
                    attempt += 1;
                    continue;
                }
                Some(_) => bail!(
                    "the map {name} was reindexed or re-created {MAX_ATTEMPTS} times during the backup; try \
                     again when it no longer changes"
                ),
            }
            self.save_images(name, page.images, &mut progress).await?;
            if page.next_cursor.is_none() {
                let MapProgress { images, left_out, .. } = progress;
                let map = ArchivedMap { name: name.clone(), images, left_out };
                return Ok(MapOutcome::Saved(map));
            }
        }
    }

    /// Fetches the vocabulary of a map, if the map has one of its own.
    async fn vocabulary(&self, name: &MapName, map: &Map) -> anyhow::Result<Option<Vocabulary>> {
        let Some(own) = &map.vocabulary else { return Ok(None) };
        let path = format!("{}/vocabulary", map_path(name));
        let response = self.client.response_with_retries(|| Ok(self.client.get(&path))).await?;
        if response.status() == StatusCode::NOT_FOUND {
            return Ok(Some(Vocabulary::Changed));
        }
        if !response.status().is_success() {
            return Err(explained(response).await);
        }
        let bytes = response.bytes().await.context("the connection closed in a vocabulary")?;
        Ok(Some(match Digest::of(&bytes) == own.digest {
            true => Vocabulary::Is(bytes),
            false => Vocabulary::Changed,
        }))
    }

    async fn save_images(
        &mut self,
        name: &MapName,
        images: Vec<ExportedImage>,
        progress: &mut MapProgress,
    ) -> anyhow::Result<()> {
        let client = &self.client;
        let fetch = |image: ExportedImage| async move {
            let fetched = fetch(client, name, &image.image).await;
            (image, fetched)
        };
        let mut fetched = futures_util::stream::iter(images).map(fetch).buffered(self.concurrency);
        while let Some((image, content)) = fetched.next().await {
            progress.last = Some(image.image.id.clone());
            match content? {
                Content::Bytes(bytes) => {
                    self.writer.image(name, &image, &bytes)?;
                    progress.images += 1;
                }
                Content::Deleted => {}
                Content::Damaged(why) => {
                    self.progress.println(&format!("{name}: {}: {why}", image.image.id));
                    let left_out = LeftOut { id: image.image.id, why };
                    self.writer.left_out(name, &left_out)?;
                    progress.left_out.push(left_out);
                }
            }
            self.progress.step();
        }
        Ok(())
    }
}

/// The vocabulary of a map on the server.
enum Vocabulary {
    Is(Bytes),
    /// It is not the one that the record of the map names.
    Changed,
}

/// The content of an image on the server.
enum Content {
    Bytes(Bytes),
    /// The image was deleted, or replaced under the same id, after its record was read.
    Deleted,
    /// The server cannot deliver the bytes that its record names.
    Damaged(String),
}

async fn fetch(client: &Client, map: &MapName, image: &Image) -> anyhow::Result<Content> {
    let path = format!("{}/images/{}", map_path(map), segment(image.id.as_str()));
    let content = || Ok(client.get(&format!("{path}/content")));
    let response = client.response_with_retries(content).await?;
    let damage = match response.status() {
        StatusCode::NOT_FOUND => return Ok(Content::Deleted),
        status if status.is_success() => {
            let bytes = response
                .bytes()
                .await
                .context("the connection closed in the middle of an image")?;
            if Digest::of(&bytes) == image.digest {
                return Ok(Content::Bytes(bytes));
            }
            "its file on the server is damaged".to_owned()
        }
        StatusCode::INTERNAL_SERVER_ERROR => explained(response).await.to_string(),
        _ => return Err(explained(response).await),
    };
    let current = client.response_with_retries(|| Ok(client.get(&path))).await?;
    match current.status().is_success() {
        true if current.json::<Image>().await?.digest == image.digest => {
            Ok(Content::Damaged(damage))
        }
        _ => Ok(Content::Deleted),
    }
}
