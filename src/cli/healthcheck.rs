//! `whereabouts healthcheck`.

use super::client::ServerArg;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    server: ServerArg,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    client.text(client.get("/readyz")).await?;
    println!("ready");
    Ok(())
}
