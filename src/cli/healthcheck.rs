//! `whereabouts healthcheck`.

use super::client::{Client, ServerArg};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    server: ServerArg,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = Client::new(&args.server)?;
    client.text(client.get("/readyz")).await?;
    println!("ready");
    Ok(())
}
