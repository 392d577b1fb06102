//! `whereabouts restore`: the maps of a backup to a server, over HTTP.

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

use super::client::{Client, ServerArg, explained, segment};
use super::progress::Progress;
use whereabouts_api::ImportedImage;
use whereabouts_archive::{ArchivedMap, End, Item, LeftOut, Reader};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, Image, ImageId, Map, MapName};

/// Images that are listed at a time.
const PAGE: usize = 1000;

/// The whole file is checked before anything is sent. Images get the descriptors that they have in the
/// file; no model runs. It is safe to run this again: what is there already is left as it is.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The file that `whereabouts backup` wrote
    file: PathBuf,
    /// Only this map; can be given several times
    #[arg(long = "map", value_name = "NAME")]
    maps: Vec<MapName>,
    /// Another name for the map, if there is one only
    #[arg(long = "as", value_name = "NAME")]
    name: Option<MapName>,
    /// Check the file and restore nothing; no server is needed
    #[arg(long)]
    check: bool,
    /// Images sent side by side
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=64))]
    concurrency: u16,
    /// Print the outcome as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

#[derive(Debug, Serialize)]
struct Outcome {
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
    /// Images whose id is taken by others on the server, which were left as they are.
    conflicts: Vec<LeftOut>,
    /// Images that the backup could not save.
    left_out: Vec<LeftOut>,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let start = Instant::now();
    let end = check(&args.file)?;
    let maps = chosen(&args, &end)?;
    if args.check {
        return said_checked(&args, &end);
    }
    let mut restore = Restore {
        client: args.server.client()?,
        progress: Progress::new("images", maps.iter().map(|map| map.images).sum()),
        concurrency: usize::from(args.concurrency),
        done: Vec::new(),
    };
    let restored = restore.all(&args, &maps).await;
    restore.progress.end();
    let said = |map: &RestoredMap| format!("{} of {}", map.added + map.present, map.name);
    restored.with_context(|| {
        let so_far: Vec<_> = restore.done.iter().map(said).collect();
        let so_far = if so_far.is_empty() { "none".to_owned() } else { so_far.join(", ") };
        format!(
            "not all is restored; on the server are these images: {so_far}. The same command adds \
             the rest"
        )
    })?;
    let seconds = start.elapsed().as_secs_f64();
    report(&Outcome { file: args.file, maps: restore.done, seconds }, args.json)
}

/// Reads the whole file; whatever is wrong with it is found before anything is sent.
fn check(file: &Path) -> anyhow::Result<End> {
    const MEGABYTE: u64 = 1 << 20;
    let refused = || format!("{} was not restored, nothing was changed", file.display());
    let total = std::fs::metadata(file).with_context(refused)?.len() / MEGABYTE;
    let mut reader = Reader::open(file).with_context(refused)?;
    let progress = Progress::new("MB checked", total as usize);
    let mut end = None;
    while let Some(item) = reader.next_item().with_context(refused)? {
        progress.at((reader.bytes() / MEGABYTE) as usize, total as usize);
        if let Item::End(found) = item {
            end = Some(found);
        }
    }
    progress.end();
    end.with_context(refused)
}

/// The maps to restore.
fn chosen(args: &Args, end: &End) -> anyhow::Result<Vec<ArchivedMap>> {
    if let Some(missing) = args.maps.iter().find(|name| end.maps.iter().all(|m| m.name != **name)) {
        let there: Vec<_> = end.maps.iter().map(|map| map.name.as_str()).collect();
        bail!("there is no map {missing} in the backup; it has {}", there.join(", "));
    }
    let wanted = |map: &&ArchivedMap| args.maps.is_empty() || args.maps.contains(&map.name);
    let maps: Vec<_> = end.maps.iter().filter(wanted).cloned().collect();
    if args.name.is_some() && maps.len() != 1 {
        bail!("--as names one map, but {} would be restored; choose one with --map", maps.len());
    }
    Ok(maps)
}

fn said_checked(args: &Args, end: &End) -> anyhow::Result<()> {
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
    println!("{}: whole, of {}", args.file.display(), end.finished_at);
    Ok(())
}

struct Restore {
    client: Client,
    progress: Progress,
    concurrency: usize,
    /// The maps so far; the last one may not be complete.
    done: Vec<RestoredMap>,
}

/// What became of one image.
enum Sent {
    Added,
    Present,
    Conflict(LeftOut),
}

impl Restore {
    async fn all(&mut self, args: &Args, maps: &[ArchivedMap]) -> anyhow::Result<()> {
        let mut reader = Reader::open(&args.file)?;
        let mut target: Option<Arc<Target>> = None;
        let mut sending = FuturesUnordered::new();
        while let Some(item) = reader.next_item()? {
            match item {
                Item::Map(map) => {
                    while let Some(sent) = sending.next().await {
                        self.count(sent)?;
                    }
                    let wanted = maps.iter().find(|wanted| wanted.name == map.name);
                    target = match wanted {
                        Some(wanted) => Some(Arc::new(self.begin(args, map, wanted).await?)),
                        None => None,
                    };
                }
                Item::Image(image, bytes) => {
                    let Some(target) = &target else { continue };
                    if sending.len() >= self.concurrency
                        && let Some(sent) = sending.next().await
                    {
                        self.count(sent)?;
                    }
                    let (client, target) = (self.client.clone(), Arc::clone(target));
                    sending.push(async move { send(&client, &target, image, bytes).await });
                }
                Item::Manifest(_) | Item::LeftOut(_) | Item::End(_) => {}
            }
        }
        while let Some(sent) = sending.next().await {
            self.count(sent)?;
        }
        Ok(())
    }

    /// Makes the map, or finds what it has.
    async fn begin(
        &mut self,
        args: &Args,
        map: Map,
        archived: &ArchivedMap,
    ) -> anyhow::Result<Target> {
        let name = args.name.clone().unwrap_or_else(|| map.name.clone());
        let path = format!("/maps/{}", segment(name.as_str()));
        self.client.send(self.client.put(&format!("{path}/import")).json(&map)).await?;
        self.done.push(RestoredMap {
            name,
            model: map.model.clone(),
            added: 0,
            present: 0,
            conflicts: Vec::new(),
            left_out: archived.left_out.clone(),
        });
        let present = present(&self.client, &path).await?;
        Ok(Target { path, map, present })
    }

    fn count(&mut self, sent: anyhow::Result<Sent>) -> anyhow::Result<()> {
        let (sent, Some(map)) = (sent?, self.done.last_mut()) else { return Ok(()) };
        match sent {
            Sent::Added => map.added += 1,
            Sent::Present => map.present += 1,
            Sent::Conflict(conflict) => {
                self.progress.say(&format!("{}: {}: {}", map.name, conflict.id, conflict.why));
                map.conflicts.push(conflict);
            }
        }
        self.progress.step();
        Ok(())
    }
}

/// Where images go.
struct Target {
    path: String,
    map: Map,
    /// What is there already.
    present: HashMap<ImageId, Digest>,
}

async fn present(client: &Client, path: &str) -> anyhow::Result<HashMap<ImageId, Digest>> {
    #[derive(Deserialize)]
    struct Page {
        images: Vec<Image>,
        next_cursor: Option<String>,
    }
    let (mut present, mut cursor) = (HashMap::new(), None::<String>);
    loop {
        let cursor_of = cursor.iter().map(|cursor| ("cursor", cursor.clone()));
        let query: Vec<_> = cursor_of.chain([("limit", PAGE.to_string())]).collect();
        let ask = || Ok(client.get(&format!("{path}/images")).query(&query));
        let page: Page = client.send_with_retries(ask).await?.json().await?;
        present.extend(page.images.into_iter().map(|image| (image.id, image.digest)));
        cursor = page.next_cursor;
        if cursor.is_none() {
            return Ok(present);
        }
    }
}

async fn send(
    client: &Client,
    target: &Target,
    image: ExportedImage,
    bytes: Bytes,
) -> anyhow::Result<Sent> {
    let (id, digest) = (image.image.id.clone(), image.image.digest);
    if target.present.get(&id) == Some(&digest) {
        return Ok(Sent::Present);
    }
    let media_type = image.image.media_type.as_str();
    let meta = serde_json::to_string(&ImportedImage { map: target.map.clone(), image })?;
    let answer = client
        .response_with_retries(|| {
            let part = Part::stream(bytes.clone()).mime_str(media_type)?;
            let form = Form::new().part("image", part).text("meta", meta.clone());
            Ok(client.post(&format!("{}/import", target.path)).multipart(form))
        })
        .await?;
    match answer.status() {
        StatusCode::CREATED => Ok(Sent::Added),
        StatusCode::OK => Ok(Sent::Present),
        StatusCode::CONFLICT if target.present.contains_key(&id) => {
            Ok(Sent::Conflict(LeftOut { id, why: explained(answer).await.to_string() }))
        }
        _ => Err(explained(answer).await.context(format!("the image {:?}", id.as_str()))),
    }
}

fn report(outcome: &Outcome, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(outcome)?);
    } else {
        for map in &outcome.maps {
            println!(
                "{}: {} images added, {} there already; descriptors of {}",
                map.name, map.added, map.present, map.model
            );
        }
        println!("{:.1} s", outcome.seconds);
    }
    let left_out: usize = outcome.maps.iter().map(|map| map.left_out.len()).sum();
    if left_out > 0 {
        eprintln!("{left_out} images were damaged when the backup was made and are not in it");
    }
    match outcome.maps.iter().map(|map| map.conflicts.len()).sum() {
        0 => Ok(()),
        images => bail!(
            "{images} images were not restored: their ids are taken by other pictures; remove \
             those, or restore under another name with --as"
        ),
    }
}
