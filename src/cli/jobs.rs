//! `whereabouts jobs`.

use serde::Deserialize;
use serde_json::Value;
use uuid::Uuid;

use super::client::{Client, ServerArg};
use super::localize::print_job;
use crate::domain::{Job, JobState, MapName};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Show this job instead of the list
    id: Option<Uuid>,
    /// Wait until the job has ended, but no longer than so many seconds
    #[arg(long, value_name = "SECONDS", requires = "id")]
    wait: Option<u64>,
    /// Only jobs of this map
    #[arg(long, conflicts_with = "id")]
    map: Option<MapName>,
    /// Only jobs in this state
    #[arg(long, conflicts_with = "id")]
    state: Option<JobState>,
    /// How many to list
    #[arg(long, default_value_t = 20, conflicts_with = "id")]
    limit: usize,
    /// Print the server's answer as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = Client::new(&args.server)?;
    let request = match args.id {
        Some(id) => {
            let wait = args.wait.map(|wait| ("wait", wait));
            client.get(&format!("/jobs/{id}")).query(&Vec::from_iter(wait))
        }
        None => {
            let filters = [
                args.map.as_ref().map(|map| ("map", map.to_string())),
                args.state.map(|state| ("state", state.to_string())),
                Some(("limit", args.limit.to_string())),
            ];
            client.get("/jobs").query(&filters.into_iter().flatten().collect::<Vec<_>>())
        }
    };
    let answer: Value = client.json(request).await?;
    match (args.json, args.id) {
        (true, _) => println!("{answer}"),
        (false, Some(_)) => print_one(&serde_json::from_value(answer)?),
        (false, None) => print_list(serde_json::from_value(answer)?),
    }
    Ok(())
}

#[derive(Deserialize)]
struct Page {
    jobs: Vec<Job>,
}

fn print_list(page: Page) {
    if page.jobs.is_empty() {
        println!("no jobs; POST /localize makes one");
    }
    for job in page.jobs {
        println!("{}  {:9}  {:5}  {}  {}", job.id, job.state, job.refiner, job.created_at, job.map);
    }
}

fn print_one(job: &Job) {
    print_job(job);
    for description in &job.descriptions {
        println!("\n{}: {}", description.image_id, description.text);
    }
}
