//! `whereabouts config`.

use std::path::PathBuf;

use whereabouts_server::config::{Config, DEFAULTS, Overrides};

/// Print the effective settings, or every setting with its default
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration file to read
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the commented defaults instead, as a file to start from
    #[arg(long)]
    defaults: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    if args.defaults {
        print!("{DEFAULTS}");
        return Ok(());
    }
    let config = Config::load(args.config.as_deref(), &Overrides::default())?;
    print!("{}", toml::to_string(&config)?);
    Ok(())
}
