//! `whereabouts keys`: over HTTP, or in the data folder of a server that does not run.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Subcommand;
use serde::Deserialize;
use uuid::Uuid;

use super::client::{Client, ServerArg};
use whereabouts_api::{MadeKey, NewKey};
use whereabouts_core::{ApiKey, KeyLimits, MapName, Role, Token};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_server::startup;
use whereabouts_service::Keys;

/// Make, list and revoke the keys that a server asks for.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
    /// Work in this data folder, whose server does not run: the way to the first key
    #[arg(long, value_name = "DIR", global = true)]
    data: Option<PathBuf>,
    /// A configuration file
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<PathBuf>,
    /// Print the answer as JSON
    #[arg(long, global = true)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Make a key, and show it this once
    Create {
        /// What people call it
        #[arg(long)]
        name: String,
        /// robot: localize; operator: jobs and images too; admin: everything
        #[arg(long)]
        role: Role,
        /// Only for this map; repeat it for more
        #[arg(long = "map", value_name = "MAP")]
        maps: Vec<MapName>,
        /// For so many days; without it for ever
        #[arg(long, value_name = "DAYS")]
        expires_days: Option<u32>,
        /// So many requests a minute at the most
        #[arg(long, value_name = "N")]
        requests_per_minute: Option<u32>,
        /// So many bytes of bodies a minute at the most
        #[arg(long, value_name = "N")]
        bytes_per_minute: Option<u64>,
    },
    /// List the keys, those that were revoked too
    List,
    /// End a key for good
    Revoke {
        /// Its id, the middle part of the key; or the key
        #[arg(value_parser = key_id)]
        id: String,
    },
}

#[derive(Deserialize)]
struct KeyList {
    keys: Vec<ApiKey>,
}

/// Where the keys are.
enum Place {
    Server(Client),
    Folder(Keys),
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let place = match args.data {
        None => Place::Server(args.server.client()?),
        Some(data) => {
            let flags = Overrides::default().data(Some(data));
            let config = Config::load(args.config.as_deref(), &flags)?;
            let new = !config.database.is_set() && !config.data.dir.join("version").exists();
            if new && !matches!(args.action, Action::Create { .. }) {
                bail!(
                    "{} is no data folder; only the first key makes one",
                    config.data.dir.display()
                );
            }
            let opening =
                tokio::task::spawn_blocking(move || startup::open_store(&config, Uuid::now_v7()));
            let opened = opening.await.context("the folder could not be opened")?.context(
                "while its server runs, leave --data out, so that the server is asked over HTTP",
            )?;
            Place::Folder(Keys::load(opened.store).await?)
        }
    };
    match args.action {
        Action::Create {
            name,
            role,
            maps,
            expires_days,
            requests_per_minute,
            bytes_per_minute,
        } => {
            let limits = KeyLimits { requests_per_minute, bytes_per_minute };
            let made = place.create(NewKey { name, role, maps, limits, expires_days }).await?;
            match args.json {
                true => println!("{}", serde_json::to_string(&made)?),
                false => {
                    println!("{}", made.token);
                    eprintln!(
                        "the key {} of {:?}, role {}; it is not shown again. Programs send it as \
                         \"Authorization: Bearer …\", these commands take it from WHEREABOUTS_API_KEY",
                        made.key.id, made.key.name, made.key.role
                    );
                }
            }
        }
        Action::List => {
            let keys = place.list().await?;
            match args.json {
                true => println!("{}", serde_json::json!({ "keys": keys })),
                false => print(&keys),
            }
        }
        Action::Revoke { id } => {
            let key = place.revoke(&id).await?;
            match args.json {
                true => println!("{}", serde_json::to_string(&key)?),
                false => println!("{}: revoked", key.id),
            }
        }
    }
    Ok(())
}

impl Place {
    async fn create(&self, wanted: NewKey) -> anyhow::Result<MadeKey> {
        match self {
            Self::Folder(keys) => Ok(keys.create(wanted).await?),
            Self::Server(client) => client.json(client.post("/keys").json(&wanted)).await,
        }
    }

    async fn list(&self) -> anyhow::Result<Vec<ApiKey>> {
        match self {
            Self::Folder(keys) => Ok(keys.list()),
            Self::Server(client) => Ok(client.json::<KeyList>(client.get("/keys")).await?.keys),
        }
    }

    async fn revoke(&self, id: &str) -> anyhow::Result<ApiKey> {
        match self {
            Self::Folder(keys) => Ok(keys.revoke(id).await?),
            Self::Server(client) => client.json(client.delete(&format!("/keys/{id}"))).await,
        }
    }
}

/// The id of a key, which goes into an address.
fn key_id(text: &str) -> Result<String, String> {
    Token::id_of(text).map(str::to_owned).ok_or_else(|| {
        format!(
            "a key's id has {} hexadecimal digits; `whereabouts keys list` shows them",
            Token::ID
        )
    })
}

fn print(keys: &[ApiKey]) {
    if keys.is_empty() {
        println!("no keys; `whereabouts keys create` makes one");
    }
    let now = jiff::Timestamp::now();
    for key in keys {
        let state = match (key.is_valid(now), key.revoked_at) {
            (true, _) => "valid",
            (false, Some(_)) => "revoked",
            (false, None) => "expired",
        };
        let maps = key.maps.iter().map(MapName::as_str).collect::<Vec<_>>().join(",");
        let maps = if maps.is_empty() { "all maps" } else { &maps };
        println!("{}  {:8}  {state:7}  {maps}  {}", key.id, key.role, key.name);
    }
}
