//! The command line: one file for each command. Client commands talk to a server.

mod backup;
mod client;
mod config;
mod demo;
mod doctor;
mod eval;
mod healthcheck;
mod index;
mod jobs;
mod keys;
mod localize;
mod migrate;
mod model;
mod openapi;
mod progress;
mod restore;
mod serve;

use std::future::Future;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use whereabouts_server::startup::Role;

/// Tells a robot where it is from one camera frame.
#[derive(Debug, Parser)]
#[command(name = "whereabouts", version, about, max_term_width = 100)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the server
    Serve(serve::Args),
    /// Refine the jobs of servers that share a database, and do nothing else
    Worker(serve::Args),
    /// Make the tables of the database, or bring them up to date
    Migrate(migrate::Args),
    /// Add a folder of images to a map on a server
    Index(index::Args),
    /// Localize a picture on a server
    Localize(localize::Args),
    /// List jobs on a server, or show one
    Jobs(jobs::Args),
    /// Make, list and revoke API keys
    Keys(keys::Args),
    /// Install models, check them, and choose the one to use
    Model(model::Args),
    /// Build a town, index it, localize frames in it, and print what happened
    Demo(demo::Args),
    /// Say how often the service is right on a folder of references and a folder of queries
    Eval(Box<eval::Args>),
    /// Save maps of a server to one file, descriptors and pictures included
    Backup(backup::Args),
    /// Bring the maps of a backup to a server
    Restore(restore::Args),
    /// Say what is in a data folder, and whether it is in order
    Doctor(doctor::Args),
    /// Print the settings in force, or every setting with its default
    Config(config::Args),
    /// Print the OpenAPI description
    Openapi,
    /// Ask a server whether it is ready; exit code 0 if so
    Healthcheck(healthcheck::Args),
}

impl Cli {
    /// Runs the command: 0 is success, 1 failure; clap itself ends with 2 on wrong usage.
    pub fn run(self) -> ExitCode {
        // Only the first call sets it; a library user may have chosen another.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let outcome = match self.command {
            Command::Serve(args) => block_on(serve::run(Role::Serve, args)),
            Command::Worker(args) => block_on(serve::run(Role::Worker, args)),
            Command::Migrate(args) => block_on(migrate::run(args)),
            Command::Index(args) => block_on(index::run(args)),
            Command::Localize(args) => block_on(localize::run(args)),
            Command::Jobs(args) => block_on(jobs::run(args)),
            Command::Keys(args) => block_on(keys::run(args)),
            Command::Model(args) => block_on(model::run(args)),
            Command::Demo(args) => block_on(demo::run(args)),
            Command::Eval(args) => block_on(eval::run(*args)),
            Command::Backup(args) => block_on(backup::run(args)),
            Command::Restore(args) => block_on(restore::run(args)),
            Command::Doctor(args) => doctor::run(args),
            Command::Config(args) => config::run(&args),
            Command::Openapi => openapi::run(),
            Command::Healthcheck(args) => block_on(healthcheck::run(args)),
        };
        match outcome {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("whereabouts: {error:#}");
                ExitCode::FAILURE
            }
        }
    }
}

fn block_on(work: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(work)
}
