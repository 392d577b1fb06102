//! `whereabouts backup`: maps of a server into one file, over HTTP.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail};
use bytes::Bytes;
use futures_util::StreamExt;
use reqwest::StatusCode;
use serde::{Deserialize, Serialize};

use super::client::{Client, ServerArg, explained, segment};
use super::progress::Progress;
use whereabouts_api::{ExportPage, MapState};
use whereabouts_archive::{
    ArchivedMap, Checkpoint, LeftOut, Manifest, Resumed, Writer, partial_path,
};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, Image, ImageId, Map, MapName};

/// Images whose records are fetched at a time.
const PAGE: usize = 256;
/// How often a map is begun anew because it changed while it was saved.
const BEGINNINGS: usize = 3;

/// The file is a tar file with a manifest and checksums. It grows as FILE.partial; a backup that was
/// interrupted goes on when the same command is run again. `whereabouts restore` brings it to a server,
/// this one or another.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The file to write
    file: PathBuf,
    /// Only this map; can be given several times
    #[arg(long = "map", value_name = "NAME")]
    maps: Vec<MapName>,
    /// Begin anew, even if an interrupted backup could go on
    #[arg(long)]
    anew: bool,
    /// Pictures fetched side by side
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
    bytes: u64,
    images: usize,
    maps: Vec<ArchivedMap>,
    /// Images that were there from an interrupted backup.
    continued: usize,
    /// Maps that were removed while the backup went on.
    gone: Vec<MapName>,
    seconds: f64,
}

/// What became of one map.
enum Saved {
    Whole(ArchivedMap),
    Gone,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let start = Instant::now();
    if args.file.exists() {
        bail!("{} is there already; choose another name or remove it", args.file.display());
    }
    let client = args.server.client()?;
    let states = states(&client, &args.maps).await?;
    let names: Vec<MapName> = states.iter().map(|map| map.name.clone()).collect();
    let (writer, resumed) = writer(&args, &names)?;
    let continued = resumed.maps.iter().map(|map| map.images).sum();
    let total = states.iter().map(|map| map.images).sum();
    let progress = Progress::new("images", total);
    progress.at(continued, total);
    let mut backup =
        Backup { client, writer, progress, concurrency: usize::from(args.concurrency) };
    let (maps, gone) = backup.maps(&names, resumed).await.with_context(|| {
        format!(
            "the backup is not whole; {} keeps what was saved, and the same command goes on from \
             there",
            partial_path(&args.file).display()
        )
    })?;
    backup.progress.end();
    backup.writer.finish(maps.clone())?;
    let outcome = Outcome {
        bytes: std::fs::metadata(&args.file).map_or(0, |file| file.len()),
        file: args.file,
        images: maps.iter().map(|map| map.images).sum(),
        maps,
        continued,
        gone,
        seconds: start.elapsed().as_secs_f64(),
    };
    report(&outcome, args.json)
}

/// The maps to save, by name.
async fn states(client: &Client, wanted: &[MapName]) -> anyhow::Result<Vec<MapState>> {
    #[derive(Deserialize)]
    struct List {
        maps: Vec<MapState>,
    }
    let mut states = Vec::new();
    if wanted.is_empty() {
        states = client.json::<List>(client.get("/maps")).await?.maps;
    }
    for name in wanted {
        states.push(client.json(client.get(&path(name))).await?);
    }
    if states.is_empty() {
        bail!("the server has no maps");
    }
    states.sort_by(|a: &MapState, b| a.name.cmp(&b.name));
    states.dedup_by(|a, b| a.name == b.name);
    Ok(states)
}

fn writer(args: &Args, names: &[MapName]) -> anyhow::Result<(Writer, Resumed)> {
    let partial = partial_path(&args.file);
    if !args.anew
        && let Some((writer, manifest, resumed)) = Writer::resume(&args.file, names)?
    {
        let images: usize = resumed.maps.iter().map(|map| map.images).sum();
        eprintln!(
            "going on with the backup of {}, which has {images} images (--anew begins anew)",
            manifest.created_at
        );
        return Ok((writer, resumed));
    }
    if partial.exists() {
        let why = if args.anew { "as you wish" } else { "it is of other maps, or unreadable" };
        eprintln!("{} is overwritten: {why}", partial.display());
    }
    Ok((Writer::begin(&args.file, &Manifest::new(names.to_vec()))?, Resumed::default()))
}

struct Backup {
    client: Client,
    writer: Writer,
    progress: Progress,
    concurrency: usize,
}

impl Backup {
    async fn maps(
        &mut self,
        names: &[MapName],
        mut resumed: Resumed,
    ) -> anyhow::Result<(Vec<ArchivedMap>, Vec<MapName>)> {
        // The last one may have more images than the archive has.
        let last = resumed.maps.pop();
        let begun = last.as_ref().and_then(|last| names.iter().position(|n| *n == last.name));
        let mut going_on = last.zip(resumed.map_start).map(|(last, begins)| Saving {
            begins,
            map: resumed.map,
            images: last.images,
            last: resumed.last,
            left_out: last.left_out,
        });
        let (mut maps, mut gone) = (resumed.maps, Vec::new());
        for name in &names[begun.unwrap_or(0)..] {
            let saving = going_on.take().unwrap_or_else(|| Saving::new(self.writer.checkpoint()));
            match self.map(name, saving).await? {
                Saved::Whole(map) => maps.push(map),
                Saved::Gone => {
                    self.progress.say(&format!("{name} was removed meanwhile and is left out"));
                    gone.push(name.clone());
                }
            }
        }
        Ok((maps, gone))
    }

    async fn map(&mut self, name: &MapName, mut saving: Saving) -> anyhow::Result<Saved> {
        let mut beginnings = 1;
        loop {
            let cursor = saving.last.as_ref().map(|id| ("cursor", id.to_string()));
            let query: Vec<_> = cursor.into_iter().chain([("limit", PAGE.to_string())]).collect();
            let ask = || Ok(self.client.get(&format!("{}/export", path(name))).query(&query));
            let answer = self.client.response_with_retries(ask).await?;
            if answer.status() == StatusCode::NOT_FOUND {
                self.writer.rewind(&saving.begins)?;
                return Ok(Saved::Gone);
            }
            if !answer.status().is_success() {
                return Err(explained(answer).await);
            }
            let page: ExportPage = answer.json().await.context("an export cannot be read")?;
            match &saving.map {
                None => {
                    self.writer.map(&page.map)?;
                    saving.map = Some(page.map);
                }
                Some(map) if (map.uid, map.revision) == (page.map.uid, page.map.revision) => {}
                Some(_) if beginnings < BEGINNINGS => {
                    self.progress.say(&format!(
                        "{name} was reindexed or made anew meanwhile, so it is saved from its \
                         beginning"
                    ));
                    self.writer.rewind(&saving.begins)?;
                    saving = Saving::new(saving.begins);
                    beginnings += 1;
                    continue;
                }
                Some(_) => bail!("the map {name} changes again and again; try later"),
            }
            self.images(name, page.images, &mut saving).await?;
            if page.next_cursor.is_none() {
                let Saving { images, left_out, .. } = saving;
                return Ok(Saved::Whole(ArchivedMap { name: name.clone(), images, left_out }));
            }
        }
    }

    async fn images(
        &mut self,
        name: &MapName,
        images: Vec<ExportedImage>,
        saving: &mut Saving,
    ) -> anyhow::Result<()> {
        let client = &self.client;
        let fetch = |image: ExportedImage| async move {
            let fetched = fetch(client, name, &image.image).await;
            (image, fetched)
        };
        let mut fetched = futures_util::stream::iter(images).map(fetch).buffered(self.concurrency);
        while let Some((image, bytes)) = fetched.next().await {
            saving.last = Some(image.image.id.clone());
            match bytes? {
                Fetched::Bytes(bytes) => {
                    self.writer.image(name, &image, &bytes)?;
                    saving.images += 1;
                }
                Fetched::Gone => {}
                Fetched::Broken(why) => {
                    self.progress.say(&format!("{name}: {}: {why}", image.image.id));
                    let left_out = LeftOut { id: image.image.id, why };
                    self.writer.left_out(name, &left_out)?;
                    saving.left_out.push(left_out);
                }
            }
            self.progress.step();
        }
        Ok(())
    }
}

/// How far a map is saved.
struct Saving {
    /// Where it begins in the archive.
    begins: Checkpoint,
    map: Option<Map>,
    images: usize,
    last: Option<ImageId>,
    left_out: Vec<LeftOut>,
}

impl Saving {
    fn new(begins: Checkpoint) -> Self {
        Self { begins, map: None, images: 0, last: None, left_out: Vec::new() }
    }
}

enum Fetched {
    Bytes(Bytes),
    /// It was removed, or its id given to another, since its record was read.
    Gone,
    /// The server does not have what it says it has.
    Broken(String),
}

async fn fetch(client: &Client, map: &MapName, image: &Image) -> anyhow::Result<Fetched> {
    let path = format!("{}/images/{}", path(map), segment(image.id.as_str()));
    let content = || Ok(client.get(&format!("{path}/content")));
    let answer = client.response_with_retries(content).await?;
    let why = match answer.status() {
        StatusCode::NOT_FOUND => return Ok(Fetched::Gone),
        status if status.is_success() => {
            let bytes = answer.bytes().await.context("a picture broke off")?;
            if Digest::of(&bytes) == image.digest {
                return Ok(Fetched::Bytes(bytes));
            }
            "its bytes on the server are damaged".to_owned()
        }
        StatusCode::INTERNAL_SERVER_ERROR => explained(answer).await.to_string(),
        _ => return Err(explained(answer).await),
    };
    let now = client.response_with_retries(|| Ok(client.get(&path))).await?;
    match now.status().is_success() {
        true if now.json::<Image>().await?.digest == image.digest => Ok(Fetched::Broken(why)),
        _ => Ok(Fetched::Gone),
    }
}

fn path(map: &MapName) -> String {
    format!("/maps/{}", segment(map.as_str()))
}

fn report(outcome: &Outcome, json: bool) -> anyhow::Result<()> {
    if json {
        println!("{}", serde_json::to_string(outcome)?);
    } else {
        for map in &outcome.maps {
            println!("{}: {} images", map.name, map.images);
        }
        println!(
            "{}: {} images of {} maps, {:.1} MB, {:.1} s",
            outcome.file.display(),
            outcome.images,
            outcome.maps.len(),
            outcome.bytes as f64 / 1e6,
            outcome.seconds
        );
    }
    match outcome.maps.iter().map(|map| map.left_out.len()).sum() {
        0 => Ok(()),
        images => bail!(
            "{images} images could not be saved, the rest is; stop the server and run `whereabouts \
             doctor --deep` on its data folder{}",
            still(&outcome.file)
        ),
    }
}

fn still(file: &Path) -> String {
    format!(" ({} can be restored without them)", file.display())
}
