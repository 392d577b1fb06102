//! `whereabouts serve` and `whereabouts worker`: the same process in two roles.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use tokio::net::TcpListener;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use whereabouts_refine::{REFINERS, RefinerEntry};
use whereabouts_server::config::{Config, Overrides, RefinerChoice};
use whereabouts_server::startup;
use whereabouts_server::startup::Role;

/// The settings that a flag can set; all others are in the file and the environment.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A configuration file; `whereabouts config --defaults` prints one with every key
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The folder where everything is kept
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Where to listen; port 0 takes any free one
    #[arg(long, value_name = "HOST:PORT")]
    listen: Option<SocketAddr>,
    /// Write the address here once the server is ready
    #[arg(long, value_name = "FILE")]
    address_file: Option<PathBuf>,
    /// The model of maps that name none
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Who refines the candidates
    #[arg(long)]
    refiner: Option<RefinerChoice>,
    /// Ask nobody for a key, whatever the server listens on: whoever reaches it may do everything
    #[arg(long)]
    no_keys: bool,
    /// Refine nothing here; other processes do (`whereabouts worker`). Needs a database (database.url)
    #[arg(long)]
    no_workers: bool,
    /// A server that speaks the OpenAI chat-completions format, for --refiner mllm; its key comes
    /// from WHEREABOUTS_MLLM__API_KEY
    #[arg(long, value_name = "URL")]
    mllm_base_url: Option<String>,
}

pub async fn run(role: Role, args: Args) -> anyhow::Result<()> {
    let flags = Overrides::default()
        .listen(args.listen)
        .data(args.data)
        .model(args.model)
        .refiner(args.refiner)
        .no_keys(args.no_keys)
        .no_workers(args.no_workers)
        .mllm_base_url(args.mllm_base_url);
    let config = Config::load(args.config.as_deref(), &flags)?;
    if role == Role::Worker {
        check_worker(&config)?;
    }
    let (troubles, _traces) =
        whereabouts_telemetry::init(&config.log, &config.traces).map_err(anyhow::Error::msg)?;
    let listener = TcpListener::bind(config.server.listen).await.with_context(|| {
        format!("cannot listen on {}; choose another with --listen", config.server.listen)
    })?;
    let shutdown = CancellationToken::new();
    tokio::spawn(cancel_on_signal(shutdown.clone()));
    startup::run(role, config, troubles, listener, shutdown, |address| {
        args.address_file.as_deref().map_or(Ok(()), |file| write_address(file, address))
    })
    .await
}

/// A worker that could not find a job, or would do nothing with one, does not start.
fn check_worker(config: &Config) -> anyhow::Result<()> {
    if !config.database.is_set() {
        bail!(
            "a worker shares a database with servers: set database.url (WHEREABOUTS_DATABASE__URL); a \
             server with the embedded store refines by itself"
        );
    }
    if config.jobs.workers == 0 {
        bail!("a worker refines: leave --no-workers out, and set jobs.workers to 1 or more");
    }
    if config.refine.refiner == RefinerChoice::OFF {
        let refiners: Vec<&str> = REFINERS.iter().map(RefinerEntry::name).collect();
        bail!(
            "a worker refines: set refine.refiner to {}, as the servers have it",
            refiners.join(" or ")
        );
    }
    Ok(())
}

async fn cancel_on_signal(shutdown: CancellationToken) {
    let (Ok(mut terminate), Ok(mut interrupt)) =
        (signal(SignalKind::terminate()), signal(SignalKind::interrupt()))
    else {
        return tracing::error!("signals cannot be caught; stop the server with SIGKILL");
    };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = interrupt.recv() => {}
    }
    shutdown.cancel();
}

/// Writes beside and renames, so that whoever waits for the file never reads half an address.
fn write_address(file: &Path, address: SocketAddr) -> anyhow::Result<()> {
    let beside = file.with_extension("tmp");
    std::fs::write(&beside, format!("{address}\n"))
        .and_then(|()| std::fs::rename(&beside, file))
        .with_context(|| format!("cannot write the address to {}", file.display()))
}
