//! `whereabouts jobs`.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use uuid::Uuid;

use super::client::{Client, ServerArg};
use super::localize::print_job;
use whereabouts_core::{Job, JobState, MapName};

/// List refinement jobs on a server, or show one
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Show this job instead of the list
    id: Option<Uuid>,
    /// Wait up to this many seconds for the job to end
    #[arg(long, value_name = "SECONDS", requires = "id")]
    wait: Option<u64>,
    /// List only jobs of this map
    #[arg(long, conflicts_with = "id")]
    map: Option<MapName>,
    /// List only jobs in this state
    #[arg(long, conflicts_with = "id")]
    state: Option<JobState>,
    /// List only jobs that contain this text, for example in an image id, an error or a description
    #[arg(long, value_name = "TEXT", conflicts_with = "id")]
    search: Option<String>,
    /// Maximum number of jobs to list
    #[arg(long, default_value_t = 20, conflicts_with = "id")]
    limit: usize,
    /// Print the server's answer as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    match args.id {
        Some(id) => {
            let wait = args.wait.map(|wait| ("wait", wait));
            let request = client.get(&format!("/jobs/{id}")).query(&Vec::from_iter(wait));
            let job: Value = client.json(request).await?;
            match args.json {
                true => println!("{job}"),
                false => print_with_descriptions(&serde_json::from_value(job)?),
            }
        }
        None => {
            let page = list(&client, &args).await?;
            match args.json {
                true => println!("{}", serde_json::to_value(page)?),
                false => print_list(page, args.search.is_some())?,
            }
        }
    }
    Ok(())
}

#[derive(Serialize, Deserialize)]
struct Page {
    jobs: Vec<Value>,
    next_cursor: Option<Uuid>,
}

/// Fetches pages until the limit or the last page is reached. A page of a search may be short although more
/// follow.
async fn list(client: &Client, args: &Args) -> anyhow::Result<Page> {
    let mut page = Page { jobs: Vec::new(), next_cursor: None };
    loop {
        let filters = [
            args.map.as_ref().map(|map| ("map", map.to_string())),
            args.state.map(|state| ("state", state.to_string())),
            args.search.as_ref().map(|text| ("q", text.clone())),
            Some(("limit", (args.limit - page.jobs.len()).to_string())),
            page.next_cursor.map(|cursor| ("cursor", cursor.to_string())),
        ];
        let request = client.get("/jobs").query(&filters.into_iter().flatten().collect::<Vec<_>>());
        let next: Page = client.json(request).await?;
        page.next_cursor = next.next_cursor;
        page.jobs.extend(next.jobs);
        if page.next_cursor.is_none() || page.jobs.len() >= args.limit {
            return Ok(page);
        }
    }
}

fn print_list(page: Page, is_search: bool) -> anyhow::Result<()> {
    if page.jobs.is_empty() {
        match is_search {
            true => println!("no job contains that text"),
            false => println!("no jobs; POST /localize queues one"),
        }
    }
    for job in page.jobs {
        let job: Job = serde_json::from_value(job)?;
        println!("{}  {:9}  {:5}  {}  {}", job.id, job.state, job.refiner, job.created_at, job.map);
    }
    Ok(())
}

fn print_with_descriptions(job: &Job) {
    print_job(job);
    for description in &job.descriptions {
        println!("\n{}: {}", description.image_id, description.text);
    }
}
