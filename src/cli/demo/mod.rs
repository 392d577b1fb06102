//! `whereabouts demo`: everything once, on a town that the binary draws itself.
//!
//! The demo starts a real server on a free port and uses it as any client would: it indexes a
//! folder, posts frames, and waits for their jobs.

mod account;
mod model;
mod pictures;
mod town;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use self::model::{Choice, Choosing};
use self::town::{Folders, Frame};
use super::client::{Client, ServerArg};
use super::index;
use whereabouts_api::Answer;
use whereabouts_core::{Job, Scene};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_server::startup::{self, Role};
use whereabouts_town::TownSpec;

/// The map's name.
const MAP: &str = "town";

/// The model is the one of --model or the settings; else DINOv2 if one is installed; else DINOv2
/// small from the hub, if that answers within seconds; else the built-in xfeat.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Where to put the pictures and the data; what an earlier demo left there is replaced
    #[arg(long, value_name = "DIR", default_value = "demo-out")]
    out: PathBuf,
    /// Places in the town; each gives one map image and one frame
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u16).range(2..=5000))]
    places: u16,
    /// Which town
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// The model
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Ask no hub; without an installed DINOv2 the model is the built-in one
    #[arg(long)]
    offline: bool,
    /// A catalogue to use instead of the built-in one
    #[arg(long, value_name = "FILE", hide = true, env = "WHEREABOUTS_CATALOGUE")]
    catalogue: Option<PathBuf>,
    /// Print the outcome as JSON
    #[arg(long)]
    json: bool,
}

/// One frame, with what the server said about it.
pub(super) struct Visit {
    frame: Frame,
    answer: Answer,
    job: Job,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let start = Instant::now();
    // The hub has the time to answer that the town takes to be drawn.
    let choosing = Choosing::begin(&args)?;
    let folders = Folders::fresh(&args.out)?;
    let spec =
        TownSpec { seed: args.seed, places: usize::from(args.places), ..TownSpec::default() };
    account::heading(&args, "1. A town");
    let frames = town::render(spec, &folders)?;
    account::rendered(&args, &folders, frames.len(), start.elapsed());

    account::heading(&args, "2. A server, and the town's pictures in a map");
    let choice = choosing.end().await?;
    account::chosen(&args, &choice);
    let server = Server::start(&folders, choice.model.clone()).await?;
    let client = server.address.client()?;
    let indexed = index_town(&client, &server.address, &folders).await?;
    account::indexed(&args, &indexed, &server.address.server);

    account::heading(&args, "3. Frames from the same places on another day");
    let visits = localize_all(&client, frames).await?;
    pictures::side_by_side(&visits, &folders)?;
    account::visits(&args, &visits, &choice, &folders, start.elapsed())?;
    server.stop().await
}

async fn index_town(
    client: &Client,
    server: &ServerArg,
    folders: &Folders,
) -> anyhow::Result<index::Outcome> {
    let args = index::Args {
        dir: None,
        reindex: false,
        map: MAP.parse()?,
        poses: None,
        scene: Some(Scene::Outdoor),
        model: None,
        descriptor: None,
        frame: None,
        concurrency: 2,
        json: false,
        server: server.clone(),
    };
    index::add_folder(client, &folders.map, &args).await
}

/// Posts every frame, one after another as a robot would, and then waits for the jobs.
async fn localize_all(client: &Client, frames: Vec<Frame>) -> anyhow::Result<Vec<Visit>> {
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
    let mut visits = Vec::with_capacity(answered.len());
    for (frame, answer) in answered {
        let link = answer.job.as_ref().context("the server queued no job")?;
        let job: Job = client.json(client.get(&format!("{}?wait=60", link.href))).await?;
        visits.push(Visit { frame, answer, job });
    }
    Ok(visits)
}

/// A server of the demo's own, in this process.
struct Server {
    address: ServerArg,
    shutdown: CancellationToken,
    running: JoinHandle<anyhow::Result<()>>,
}

impl Server {
    async fn start(folders: &Folders, model: String) -> anyhow::Result<Self> {
        let flags = Overrides::default()
            .listen(Some(([127, 0, 0, 1], 0).into()))
            .data(Some(folders.data.clone()))
            .model(Some(model));
        let mut config = Config::load(None, &flags)?;
        "warn".clone_into(&mut config.log.filter);
        let (troubles, _traces) =
            whereabouts_telemetry::init(&config.log, &config.traces).map_err(anyhow::Error::msg)?;
        let listener = TcpListener::bind(config.server.listen).await?;
        let (announce, ready) = oneshot::channel();
        let shutdown = CancellationToken::new();
        let until = shutdown.clone();
        let running =
            tokio::spawn(startup::run(Role::Serve, config, troubles, listener, until, |address| {
                let _ = announce.send(address);
                Ok(())
            }));
        match ready.await {
            Ok(address) => {
                let address = ServerArg { server: format!("http://{address}"), api_key: None };
                Ok(Self { address, shutdown, running })
            }
            Err(_) => match running.await? {
                Ok(()) => anyhow::bail!("the server ended before it was ready"),
                Err(error) => Err(error),
            },
        }
    }

    async fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        self.running.await?
    }
}

/// A path as a user would type it.
fn shown(path: &Path) -> String {
    path.display().to_string()
}
