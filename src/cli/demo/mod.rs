//! `whereabouts demo`: every step once, on a rendered town.
//!
//! The demo starts a real server on a free port and uses it as any client would: it indexes a
//! folder, posts frames, and waits for their jobs.

mod model;
mod pictures;
mod report;
mod town;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use clap::ValueEnum;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use self::model::{ModelChoice, PendingChoice};
use self::report::Reporter;
use self::town::{DemoFolders, Frame};
use super::client::{Client, ServerArg};
use super::index;
use whereabouts_api::{Answer, MapState, MapTexts};
use whereabouts_core::{Job, Scene};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_server::startup::{self, Role};
use whereabouts_town::{TownScene, TownSpec};

/// Pause between two looks at how much is read.
const READ_PAUSE: Duration = Duration::from_millis(200);

/// The map's name.
const MAP: &str = "town";

/// Render a town, index it, localize frames in it, and print the results
///
/// Uses the model that --model or the configuration names, otherwise an installed DINOv2, otherwise
/// dinov2-small from the hub if the hub answers within seconds, otherwise the built-in xfeat.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder for the images and the data; replaces the output of an earlier demo
    #[arg(long, value_name = "DIR", default_value = "demo-out")]
    out: PathBuf,
    /// What is built in the town
    #[arg(long, value_enum, default_value_t)]
    scene: SceneArg,
    /// Number of places in the town; each has one map image and one frame
    #[arg(long, value_name = "N", default_value_t = 40)]
    #[arg(value_parser = clap::value_parser!(u16).range(2..=5000))]
    places: u16,
    /// Seed of the town
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Model to use
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Do not contact the hub; if no DINOv2 is installed, use the built-in model
    #[arg(long)]
    offline: bool,
    /// Catalogue to use instead of the built-in one
    #[arg(long, value_name = "FILE", hide = true, env = "WHEREABOUTS_CATALOGUE")]
    catalogue: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// What is built in the town.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum SceneArg {
    /// Streets with houses and shops of many styles
    #[default]
    Streets,
    /// Shop fronts of one style that differ in the names on their signs only; for `make reader`
    Mall,
}

/// One frame with the server's answer and the job.
pub(super) struct LocalizedFrame {
    frame: Frame,
    answer: Answer,
    job: Job,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let start = Instant::now();
    let reporter = Reporter { json: args.json };
    // The hub may answer while the town is rendered.
    let pending = PendingChoice::begin(&args)?;
    let folders = DemoFolders::create(&args.out)?;
    let scene = match args.scene {
        SceneArg::Streets => TownScene::Streets,
        SceneArg::Mall => TownScene::Mall,
    };
    let places = usize::from(args.places);
    let spec = TownSpec { scene, seed: args.seed, places, ..TownSpec::default() };
    reporter.heading("1. A town");
    let frames = town::render(spec, &folders)?;
    reporter.rendered(&folders, frames.len(), start.elapsed());

    reporter.heading("2. A server, with the town's images in a map");
    let choice = pending.resolve().await?;
    reporter.model(&choice);
    let server = DemoServer::start(&folders, choice.model.clone()).await?;
    let client = server.address.client()?;
    let indexed = index_town(&client, &server.address, &folders).await?;
    reporter.indexed(&indexed, &server.address.server);
    reporter.read(read_signs(&client).await?.as_ref());

    reporter.heading("3. Frames from the same places on another day");
    let localized = localize_all(&client, frames).await?;
    pictures::write_all(&localized, &folders)?;
    reporter.results(&localized, &choice, &folders, start.elapsed());
    server.stop().await
}

async fn index_town(
    client: &Client,
    server: &ServerArg,
    folders: &DemoFolders,
) -> anyhow::Result<index::IndexReport> {
    let args = index::Args {
        dir: None,
        reindex: false,
        map: MAP.parse()?,
        poses: None,
        scene: Some(Scene::Outdoor),
        model: None,
        descriptor: None,
        vocabulary: None,
        frame: None,
        concurrency: 2,
        json: false,
        server: server.clone(),
    };
    index::add_folder(client, &folders.map, &args).await
}

/// Waits until the signs in the images are read, so that jobs can compare them; `None` without a reader.
async fn read_signs(client: &Client) -> anyhow::Result<Option<MapTexts>> {
    loop {
        let map: MapState = client.json(client.get(&format!("/maps/{MAP}"))).await?;
        match map.texts {
            Some(MapTexts { waiting: Some(waiting), .. }) if waiting > 0 => {
                tokio::time::sleep(READ_PAUSE).await;
            }
            texts => return Ok(texts),
        }
    }
}

/// Posts the frames one after another, as a robot would, and then waits for their jobs.
async fn localize_all(client: &Client, frames: Vec<Frame>) -> anyhow::Result<Vec<LocalizedFrame>> {
    let mut answered = Vec::with_capacity(frames.len());
    for frame in frames {
        let bytes = std::fs::read(&frame.file)?;
        let request = client
            .post(&format!("/localize?map={MAP}&k=10&refine=async"))
            .header("content-type", "image/jpeg")
            .body(bytes);
        let answer: Answer = client.json(request).await?;
        answered.push((frame, answer));
    }
    let mut localized = Vec::with_capacity(answered.len());
    for (frame, answer) in answered {
        let link = answer.job.as_ref().context("the server queued no job")?;
        let job: Job = client.json(client.get(&format!("{}?wait=60", link.href))).await?;
        localized.push(LocalizedFrame { frame, answer, job });
    }
    Ok(localized)
}

/// A server in this process.
struct DemoServer {
    address: ServerArg,
    shutdown: CancellationToken,
    running: JoinHandle<anyhow::Result<()>>,
}

impl DemoServer {
    async fn start(folders: &DemoFolders, model: String) -> anyhow::Result<Self> {
        let flags = Overrides::default()
            .listen(Some(([127, 0, 0, 1], 0).into()))
            .data(Some(folders.data.clone()))
            .model(Some(model));
        let mut config = Config::load(None, &flags)?;
        "warn".clone_into(&mut config.log.filter);
        let (log_issues, _traces) =
            whereabouts_telemetry::init(&config.log, &config.traces).map_err(anyhow::Error::msg)?;
        let listener = TcpListener::bind(config.server.listen).await?;
        let (announce, ready) = oneshot::channel();
        let shutdown = CancellationToken::new();
        let cancelled = shutdown.clone();
        let on_ready = |address| {
            // The receiver is dropped only after it has received.
            let _ = announce.send(address);
            Ok(())
        };
        let running = tokio::spawn(startup::run(
            Role::Serve,
            config,
            log_issues,
            listener,
            cancelled,
            on_ready,
        ));
        match ready.await {
            Ok(address) => {
                let address = ServerArg { server: format!("http://{address}"), api_key: None };
                Ok(Self { address, shutdown, running })
            }
            Err(_) => match running.await? {
                Ok(()) => anyhow::bail!("the server stopped before it was ready"),
                Err(error) => Err(error),
            },
        }
    }

    async fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        self.running.await?
    }
}

/// Formats a path as a user would type it.
fn shown(path: &Path) -> String {
    path.display().to_string()
}
