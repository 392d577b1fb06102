//! `whereabouts descriptions`: what models wrote, and was paid for.

use anyhow::bail;
use clap::Subcommand;
use serde_json::Value;
use whereabouts_api::{DescriptionPage, KeyedDescription, PurgedDescriptions};
use whereabouts_core::{Digest, ImageId, MapName};

use super::client::{Client, ServerArg};

/// List, show and remove cached descriptions of pairs
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
    /// Print the server's answer as JSON
    #[arg(long, global = true)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List cached descriptions
    List {
        #[command(flatten)]
        which: Which,
        /// Maximum number of descriptions to list
        #[arg(long, default_value_t = 20)]
        limit: usize,
    },
    /// Show one cached description
    Show {
        /// Key of the description, as the list shows it
        key: Digest,
    },
    /// Remove cached descriptions; the pairs are described again when a job needs them
    Purge {
        /// Key of one description
        #[arg(conflicts_with_all = ["map", "image", "model", "model_server", "search", "all"])]
        key: Option<Digest>,
        #[command(flatten)]
        which: Which,
        /// Remove all descriptions
        #[arg(long)]
        all: bool,
    },
}

#[derive(Debug, clap::Args)]
struct Which {
    /// Only descriptions of this map
    #[arg(long)]
    map: Option<MapName>,
    /// Only descriptions of pairs with this image
    #[arg(long)]
    image: Option<ImageId>,
    /// Only descriptions by this model
    #[arg(long)]
    model: Option<String>,
    /// Only descriptions from the model server at this base URL
    #[arg(long, value_name = "URL")]
    model_server: Option<String>,
    /// Only descriptions that contain this text
    #[arg(long, value_name = "TEXT")]
    search: Option<String>,
}

impl Which {
    fn query(&self) -> Vec<(&'static str, String)> {
        let fields = [
            self.map.as_ref().map(|map| ("map", map.to_string())),
            self.image.as_ref().map(|image| ("image", image.to_string())),
            self.model.clone().map(|model| ("model", model)),
            self.model_server.clone().map(|server| ("model_server", server)),
            self.search.clone().map(|text| ("q", text)),
        ];
        fields.into_iter().flatten().collect()
    }
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    match args.action {
        Action::List { which, limit } => {
            let query = [which.query(), vec![("limit", limit.to_string())]].concat();
            let answer = client.json(client.get("/descriptions").query(&query)).await?;
            print(args.json, answer, |page: DescriptionPage| {
                if page.descriptions.is_empty() {
                    println!("no descriptions");
                }
                page.descriptions.iter().for_each(print_line);
            })
        }
        Action::Show { key } => {
            let answer = client.json(client.get(&format!("/descriptions/{key}"))).await?;
            print(args.json, answer, |found: KeyedDescription| {
                print_line(&found);
                println!("\n{}", found.description.text);
            })
        }
        Action::Purge { key, which, all } => {
            let answer = purge(&client, key, &which, all).await?;
            print(args.json, answer, |purged: PurgedDescriptions| {
                println!("removed {} descriptions", purged.removed);
            })
        }
    }
}

async fn purge(
    client: &Client,
    key: Option<Digest>,
    which: &Which,
    all: bool,
) -> anyhow::Result<Value> {
    let mut query = which.query();
    if key.is_none() && query.is_empty() && !all {
        bail!(
            "say which descriptions to remove: a key, --map, --image, --model, --model-server, --search or --all"
        );
    }
    if all {
        query.push(("all", "true".to_owned()));
    }
    let request = match key {
        Some(key) => client.delete(&format!("/descriptions/{key}")),
        None => client.delete("/descriptions").query(&query),
    };
    client.json(request).await
}

fn print<T: serde::de::DeserializeOwned>(
    json: bool,
    answer: Value,
    show: impl FnOnce(T),
) -> anyhow::Result<()> {
    match json {
        true => println!("{answer}"),
        false => show(serde_json::from_value(answer)?),
    }
    Ok(())
}

fn print_line(found: &KeyedDescription) {
    let KeyedDescription { key, description } = found;
    let about = match &description.about {
        Some(about) => {
            format!("{}  {}  {}  {}", about.map, about.image_id, about.model, about.server)
        }
        None => "(from an earlier version)".to_owned(),
    };
    println!("{key}  {}  {about}", description.created_at);
}
