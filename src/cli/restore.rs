//! `whereabouts restore`: restores the maps of a backup to a server, over HTTP.

mod places;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, bail};
use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use reqwest::StatusCode;
use reqwest::multipart::{Form, Part};
use serde::{Deserialize, Serialize};

use self::places::Places;
use super::client::{Client, ServerArg, explained, segment};
use super::progress::ProgressMeter;
use whereabouts_api::{ImportedImage, ImportedMap};
use whereabouts_archive::{ArchivedMap, End, Item, LeftOut, Reader};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, Image, ImageId, Map, MapName};

/// Image records that are listed with one request.
const PAGE_SIZE: usize = 1000;

/// Restore maps from a backup to a server
///
/// The whole file is verified before anything is sent. Images keep the descriptors that they have in the
/// file, so no model runs. It is safe to run this again: images that the server already has are skipped.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// File written by `whereabouts backup`
    file: PathBuf,
    /// Restore only this map; repeat the flag for more
    #[arg(long = "map", value_name = "NAME")]
    maps: Vec<MapName>,
    /// Restore the map under another name; needs exactly one map
    #[arg(long = "as", value_name = "NAME")]
    name: Option<MapName>,
    /// Verify the file and restore nothing; needs no server
    #[arg(long)]
    check: bool,
    /// Number of images to send concurrently
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
struct RestoreReport {
    file: PathBuf,
    maps: Vec<RestoredMap>,
    seconds: f64,
}

#[derive(Debug, Serialize)]
struct RestoredMap {
    name: MapName,
    /// The model of its descriptors.
    model: String,
    added: usize,
    present: usize,
    /// Images whose id has other bytes on the server, which were left unchanged.
    conflicts: Vec<LeftOut>,
    /// Images that the backup could not save.
    left_out: Vec<LeftOut>,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let start = Instant::now();
    let (end, places) = verify(&args.file)?;
    let maps = select_maps(&args, &end)?;
    if args.check {
        return print_contents(&args, &end);
    }
    let mut restore = Restore {
        client: args.server.client()?,
        progress: ProgressMeter::new("images", maps.iter().map(|map| map.images).sum()),
        concurrency: usize::from(args.concurrency),
        places,
        maps: Vec::new(),
    };
    let result = restore.send_all(&args, &maps).await;
    restore.progress.finish();
    result.with_context(|| {
        let count = |map: &RestoredMap| format!("{} of {}", map.added + map.present, map.name);
        let counts: Vec<_> = restore.maps.iter().map(count).collect();
        let counts = if counts.is_empty() { "none".to_owned() } else { counts.join(", ") };
        format!(
            "the restore is incomplete; images on the server so far: {counts}. The same command adds the rest"
        )
    })?;
    let seconds = start.elapsed().as_secs_f64();
    print(&RestoreReport { file: args.file, maps: restore.maps, seconds }, args.json)
}

/// Reads the whole file, so that damage is found before anything is sent. Returns also the order of the images.
fn verify(file: &Path) -> anyhow::Result<(End, Places)> {
    const MEGABYTE: u64 = 1 << 20;
    let refused = || format!("{} was not restored, nothing was changed", file.display());
    let total = std::fs::metadata(file).with_context(refused)?.len() / MEGABYTE;
    let mut reader = Reader::open(file).with_context(refused)?;
    let progress = ProgressMeter::new("MB verified", total as usize);
    let (mut end, mut places) = (None, Places::default());
    while let Some(item) = reader.next_item().with_context(refused)? {
        progress.set((reader.bytes() / MEGABYTE) as usize, total as usize);
        match item {
            Item::Map(map, _) => places.begin(map),
            Item::Image(image, _) => places.add(&image),
            Item::End(found) => end = Some(found),
            Item::Manifest(_) | Item::LeftOut(_) => {}
        }
    }
    progress.finish();
    Ok((end.with_context(refused)?, places.numbered()))
}

/// Returns the maps that the flags select.
fn select_maps(args: &Args, end: &End) -> anyhow::Result<Vec<ArchivedMap>> {
    if let Some(missing) = args.maps.iter().find(|name| end.maps.iter().all(|m| m.name != **name)) {
        let names: Vec<_> = end.maps.iter().map(|map| map.name.as_str()).collect();
        bail!("the backup has no map {missing}; it has {}", names.join(", "));
    }
    let is_selected = |map: &&ArchivedMap| args.maps.is_empty() || args.maps.contains(&map.name);
    let maps: Vec<_> = end.maps.iter().filter(is_selected).cloned().collect();
    if args.name.is_some() && maps.len() != 1 {
        bail!(
            "--as needs exactly one map, but {} would be restored; select one with --map",
            maps.len()
        );
    }
    Ok(maps)
}

fn print_contents(args: &Args, end: &End) -> anyhow::Result<()> {
    if args.json {
        println!("{}", serde_json::to_string(end)?);
        return Ok(());
    }
    for map in &end.maps {
        let left_out = match map.left_out.len() {
            0 => String::new(),
            images => format!(", {images} could not be saved"),
        };
        println!("{}: {} images{left_out}", map.name, map.images);
    }
    println!("{}: complete, written {}", args.file.display(), end.finished_at);
    Ok(())
}

struct Restore {
    client: Client,
    progress: ProgressMeter,
    concurrency: usize,
    places: Places,
    /// The maps so far; the last one may be incomplete.
    maps: Vec<RestoredMap>,
}

/// How the server answered to one image.
enum SendOutcome {
    Added,
    Present,
    Conflict(LeftOut),
}

impl Restore {
    async fn send_all(&mut self, args: &Args, maps: &[ArchivedMap]) -> anyhow::Result<()> {
        let mut reader = Reader::open(&args.file)?;
        let mut target: Option<Arc<Target>> = None;
        let mut in_flight = FuturesUnordered::new();
        while let Some(item) = reader.next_item()? {
            match item {
                Item::Map(map, vocabulary) => {
                    while let Some(outcome) = in_flight.next().await {
                        self.count(outcome)?;
                    }
                    target = match maps.iter().find(|selected| selected.name == map.name) {
                        Some(archived) => {
                            Some(Arc::new(self.open(args, map, vocabulary, archived).await?))
                        }
                        None => None,
                    };
                }
                Item::Image(mut image, bytes) => {
                    let Some(target) = &target else { continue };
                    image.recording = self.places.of(&target.map, &image);
                    if in_flight.len() >= self.concurrency
                        && let Some(outcome) = in_flight.next().await
                    {
                        self.count(outcome)?;
                    }
                    let (client, target) = (self.client.clone(), Arc::clone(target));
                    in_flight.push(async move { send(&client, &target, image, bytes).await });
                }
                Item::Manifest(_) | Item::LeftOut(_) | Item::End(_) => {}
            }
        }
        while let Some(outcome) = in_flight.next().await {
            self.count(outcome)?;
        }
        Ok(())
    }

    /// Creates the map unless it exists, and lists the images that it has.
    async fn open(
        &mut self,
        args: &Args,
        map: Map,
        vocabulary: Option<Bytes>,
        archived: &ArchivedMap,
    ) -> anyhow::Result<Target> {
        let name = args.name.clone().unwrap_or_else(|| map.name.clone());
        let path = format!("/maps/{}", segment(name.as_str()));
        let import = ImportedMap { map, vocabulary_data: vocabulary.map(Into::into) };
        self.client.send(self.client.put(&format!("{path}/import")).json(&import)).await?;
        let map = import.map;
        self.maps.push(RestoredMap {
            name,
            model: map.model.clone(),
            added: 0,
            present: 0,
            conflicts: Vec::new(),
            left_out: archived.left_out.clone(),
        });
        let present = list_images(&self.client, &path).await?;
        Ok(Target { path, map, present })
    }

    fn count(&mut self, outcome: anyhow::Result<SendOutcome>) -> anyhow::Result<()> {
        let (outcome, Some(map)) = (outcome?, self.maps.last_mut()) else { return Ok(()) };
        match outcome {
            SendOutcome::Added => map.added += 1,
            SendOutcome::Present => map.present += 1,
            SendOutcome::Conflict(conflict) => {
                self.progress.println(&format!("{}: {}: {}", map.name, conflict.id, conflict.why));
                map.conflicts.push(conflict);
            }
        }
        self.progress.step();
        Ok(())
    }
}

/// The map on the server that images are sent to.
struct Target {
    path: String,
    map: Map,
    /// The images that it had at first.
    present: HashMap<ImageId, Digest>,
}

async fn list_images(client: &Client, path: &str) -> anyhow::Result<HashMap<ImageId, Digest>> {
    #[derive(Deserialize)]
    struct Page {
        images: Vec<Image>,
        next_cursor: Option<String>,
    }
    let (mut images, mut cursor) = (HashMap::new(), None::<String>);
    loop {
        let cursor_parameter = cursor.iter().map(|cursor| ("cursor", cursor.clone()));
        let query: Vec<_> = cursor_parameter.chain([("limit", PAGE_SIZE.to_string())]).collect();
        let request = || Ok(client.get(&format!("{path}/images")).query(&query));
        let page: Page = client.send_with_retries(request).await?.json().await?;
        images.extend(page.images.into_iter().map(|image| (image.id, image.digest)));
        cursor = page.next_cursor;
        if cursor.is_none() {
            return Ok(images);
        }
    }
}

async fn send(
    client: &Client,
    target: &Target,
    image: ExportedImage,
    bytes: Bytes,
) -> anyhow::Result<SendOutcome> {
    let (id, digest) = (image.image.id.clone(), image.image.digest);
    if target.present.get(&id) == Some(&digest) {
        return Ok(SendOutcome::Present);
    }
    let media_type = image.image.media_type.as_str();
    let meta = serde_json::to_string(&ImportedImage { map: target.map.clone(), image })?;
    let response = client
        .response_with_retries(|| {
            let part = Part::stream(bytes.clone()).mime_str(media_type)?;
            let form = Form::new().part("image", part).text("meta", meta.clone());
            Ok(client.post(&format!("{}/import", target.path)).multipart(form))
        })
        .await?;
    match response.status() {
        StatusCode::CREATED => Ok(SendOutcome::Added),
        StatusCode::OK => Ok(SendOutcome::Present),
        StatusCode::CONFLICT if target.present.contains_key(&id) => {
            Ok(SendOutcome::Conflict(LeftOut { id, why: explained(response).await.to_string() }))
        }
        _ => Err(explained(response).await.context(format!("the image {:?}", id.as_str()))),
    }
}

/// Prints the report. Conflicts are an error.
fn print(report: &RestoreReport, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(report)?);
    } else {
        for map in &report.maps {
            println!(
                "{}: {} images added, {} already present; descriptors of {}",
                map.name, map.added, map.present, map.model
            );
        }
        println!("{:.1} s", report.seconds);
    }
    let left_out: usize = report.maps.iter().map(|map| map.left_out.len()).sum();
    if left_out > 0 {
        eprintln!("{left_out} images are not in the backup: they were damaged when it was made");
    }
    match report.maps.iter().map(|map| map.conflicts.len()).sum() {
        0 => Ok(()),
        images => bail!(
            "{images} images were not restored: their ids are taken by other images on the server; delete \
             those, or restore under another name with --as"
        ),
    }
}
