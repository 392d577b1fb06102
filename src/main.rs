//! Parses the command line and dispatches.

use std::process::ExitCode;

use clap::Parser;
use whereabouts_cli::Cli;

fn main() -> ExitCode {
    Cli::parse().run()
}
