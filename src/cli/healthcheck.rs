//! `whereabouts healthcheck`.

use super::client::ServerArg;

/// Check whether a server is ready; the exit code is 0 if it is and 1 if not
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
