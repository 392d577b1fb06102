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

/// The settings that have a flag; all others come from the configuration file and the environment.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration file; `whereabouts config --defaults` prints one with every setting
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Data folder
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// IP address and port to listen on; port 0 picks a free port
    #[arg(long, value_name = "IP:PORT", value_parser = listen_address)]
    listen: Option<SocketAddr>,
    /// Write the bound address to this file once the server is ready
    #[arg(long, value_name = "FILE")]
    address_file: Option<PathBuf>,
    /// Default model, for maps that do not name one
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// Refiner of the candidates
    #[arg(long)]
    refiner: Option<RefinerChoice>,
    /// Require no API key, whatever address the server listens on: anyone who can reach it has full access
    #[arg(long)]
    no_keys: bool,
    /// Do not refine in this process but leave it to others (`whereabouts worker`); needs a database
    /// (database.url)
    #[arg(long)]
    no_workers: bool,
    /// URL of a server with the OpenAI chat-completions API, for --refiner mllm; its key is read from
    /// WHEREABOUTS_MLLM__API_KEY
    #[arg(long, value_name = "URL")]
    mllm_base_url: Option<String>,
}

fn listen_address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "expected an IP address and a port, such as 127.0.0.1:8080".into())
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
    let (log_issues, _traces) =
        whereabouts_telemetry::init(&config.log, &config.traces).map_err(anyhow::Error::msg)?;
    let listener = TcpListener::bind(config.server.listen).await.with_context(|| {
        format!("cannot listen on {}; choose another address with --listen", config.server.listen)
    })?;
    let shutdown = CancellationToken::new();
    tokio::spawn(cancel_on_signal(shutdown.clone()));
    startup::run(role, config, log_issues, listener, shutdown, |address| {
        args.address_file.as_deref().map_or(Ok(()), |file| write_address(file, address))
    })
    .await
}

/// Refuses a configuration under which a worker would never find a job or could not refine it.
fn check_worker(config: &Config) -> anyhow::Result<()> {
    if !config.database.is_set() {
        bail!(
            "a worker needs the database of its servers: set database.url (WHEREABOUTS_DATABASE__URL). A \
             server with the embedded store needs no worker: it refines in its own process"
        );
    }
    if config.jobs.workers == 0 {
        bail!(
            "this worker would refine nothing: remove --no-workers and set jobs.workers to 1 or more"
        );
    }
    if config.refine.refiner == RefinerChoice::OFF {
        let refiners: Vec<&str> = REFINERS.iter().map(RefinerEntry::name).collect();
        bail!(
            "this worker would refine nothing: set refine.refiner to {}, as on the servers",
            refiners.join(" or ")
        );
    }
    Ok(())
}

async fn cancel_on_signal(shutdown: CancellationToken) {
    let (Ok(mut terminate), Ok(mut interrupt)) =
        (signal(SignalKind::terminate()), signal(SignalKind::interrupt()))
    else {
        return tracing::error!("cannot install signal handlers; stop the server with SIGKILL");
    };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = interrupt.recv() => {}
    }
    shutdown.cancel();
}

/// Writes a temporary file and renames it, so that a reader never sees half an address.
fn write_address(file: &Path, address: SocketAddr) -> anyhow::Result<()> {
    let temporary = file.with_extension("tmp");
    std::fs::write(&temporary, format!("{address}\n"))
        .and_then(|()| std::fs::rename(&temporary, file))
        .with_context(|| format!("cannot write the address to {}", file.display()))
}
