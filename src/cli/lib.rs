//! The command line: one module for each command. Client commands talk to a server.

#[macro_use]
mod output;

mod backup;
mod client;
mod config;
mod demo;
mod descriptions;
mod doctor;
mod eval;
mod find;
mod healthcheck;
#[cfg(test)]
mod help_tests;
mod index;
mod jobs;
mod keys;
mod localize;
mod manual;
mod migrate;
mod mllm;
mod model;
mod openapi;
mod progress;
mod read;
mod restore;
mod serve;

use std::future::Future;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use whereabouts_server::startup::Role;

/// Visual place recognition as a service: localizes a robot from one camera frame
#[derive(Debug, Parser)]
#[command(name = "whereabouts", version, max_term_width = 100)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

// The help of a command is the doc comment of its `Args`. A doc comment here would replace it, as it does
// for the two commands that share their arguments.
#[derive(Debug, Subcommand)]
enum Command {
    /// Run the server
    Serve(serve::Args),
    /// Run a worker that refines the jobs of servers that share a database
    Worker(serve::Args),
    Migrate(migrate::Args),
    Index(index::Args),
    Localize(localize::Args),
    Read(read::Args),
    Find(find::Args),
    Jobs(jobs::Args),
    Keys(keys::Args),
    Model(model::Args),
    Mllm(mllm::Args),
    Descriptions(descriptions::Args),
    Demo(demo::Args),
    Eval(Box<eval::Args>),
    Backup(backup::Args),
    Restore(restore::Args),
    Doctor(doctor::Args),
    Config(config::Args),
    /// Print the OpenAPI description of the HTTP API
    Openapi,
    Completions(manual::CompletionsArgs),
    Man(manual::ManArgs),
    Healthcheck(healthcheck::Args),
}

impl Cli {
    /// Runs the command. The exit code is 0 on success and 1 on failure; clap exits with 2 on wrong usage.
    pub fn run(self) -> ExitCode {
        // Fails if a provider is installed already, which is then used instead.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let result = match self.command {
            Command::Serve(args) => block_on(serve::run(Role::Serve, args)),
            Command::Worker(args) => block_on(serve::run(Role::Worker, args)),
            Command::Migrate(args) => block_on(migrate::run(args)),
            Command::Index(args) => block_on(index::run(args)),
            Command::Localize(args) => block_on(localize::run(args)),
            Command::Read(args) => read::run(&args),
            Command::Find(args) => block_on(find::run(args)),
            Command::Jobs(args) => block_on(jobs::run(args)),
            Command::Keys(args) => block_on(keys::run(args)),
            Command::Model(args) => block_on(model::run(args)),
            Command::Mllm(args) => block_on(mllm::run(args)),
            Command::Descriptions(args) => block_on(descriptions::run(args)),
            Command::Demo(args) => block_on(demo::run(args)),
            Command::Eval(args) => block_on(eval::run(*args)),
            Command::Backup(args) => block_on(backup::run(args)),
            Command::Restore(args) => block_on(restore::run(args)),
            Command::Doctor(args) => doctor::run(args),
            Command::Config(args) => config::run(&args),
            Command::Openapi => openapi::run(),
            Command::Completions(args) => manual::completions(&args),
            Command::Man(args) => manual::man(&args),
            Command::Healthcheck(args) => block_on(healthcheck::run(args)),
        };
        match result {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("whereabouts: {}", message(&error));
                ExitCode::FAILURE
            }
        }
    }
}

/// The message of an error and those of its causes, each once: many messages contain that of their cause.
fn message(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

fn block_on(command: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(command)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_is_printed_once() {
        let cause = std::io::Error::other("is a directory");
        let error = anyhow::Error::new(cause).context("cannot read m: is a directory; name a file");
        let error = error.context("m was not installed");
        let text = "m was not installed: cannot read m: is a directory; name a file";
        assert_eq!(message(&error), text);
    }
}
