//! `whereabouts mllm`: the multimodal models of the configuration.

use std::path::PathBuf;

use anyhow::bail;
use clap::Subcommand;
use whereabouts_refine::mllm::{CheckedServer, check};
use whereabouts_server::config::{Config, Overrides};

/// Check the multimodal models that the refiner `mllm` is configured to use
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Find out with a few small requests whether the servers answer and what they can do
    ///
    /// Run this first. It asks for a reply to two small pictures and for a ranking, and prints what the refiner
    /// makes of the answers. The exit code is 0 if the refiner can work with them and 1 otherwise.
    Check {
        /// Configuration file to read
        #[arg(long, value_name = "FILE")]
        config: Option<PathBuf>,
        /// Print the findings as JSON
        #[arg(long)]
        json: bool,
    },
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let Action::Check { config, json } = args.action;
    let settings = Config::load(config.as_deref(), &Overrides::default())?.mllm;
    let checked = check(&settings).await?;
    match json {
        true => println!("{}", serde_json::json!({ "servers": checked })),
        false => checked.iter().for_each(print),
    }
    let findings = || checked.iter().flat_map(|server| &server.findings);
    match findings().find(|finding| !finding.ok) {
        Some(finding) => bail!("the refiner mllm cannot work with it: {}", finding.detail),
        None => Ok(()),
    }
}

fn print(checked: &CheckedServer) {
    let CheckedServer { used_for, findings, server } = checked;
    println!("{} ({}), for {used_for}", server.url, server.models.join(", "));
    for finding in findings {
        let mark = if finding.ok { "ok    " } else { "FAILED" };
        println!("  {mark}  {}: {}", finding.what, finding.detail);
    }
    let can = &server.capabilities;
    let limit = |limit: Option<u64>| limit.map_or("unknown".to_owned(), |limit| limit.to_string());
    println!("  answers are asked for as {}", can.answer_format);
    println!("  temperature: {}", if can.temperature { "sent" } else { "not sent" });
    let field = can.max_tokens_field.as_deref().unwrap_or("none");
    println!("  field for the longest answer: {field}");
    println!("  system message: {}", if can.system_message { "sent" } else { "not sent" });
    println!("  context: {} tokens", limit(can.context_tokens));
    println!("  calls at once: {}", can.calls_at_once);
}
