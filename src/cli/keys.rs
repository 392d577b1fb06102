//! `whereabouts keys`: over HTTP, or in the data folder of a stopped server.

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

/// Create, list and revoke API keys
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
    /// Work in the data folder of a stopped server instead of over HTTP; this is how to create the first key
    #[arg(long, value_name = "DIR", global = true)]
    data: Option<PathBuf>,
    /// Configuration file, for --data
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
    /// Create a key and print it; it is shown only once
    Create {
        /// Display name of the key
        #[arg(long)]
        name: String,
        /// robot: localize; operator: also jobs and images; admin: everything
        #[arg(long)]
        role: Role,
        /// Restrict the key to this map; repeat the flag for more
        #[arg(long = "map", value_name = "MAP")]
        maps: Vec<MapName>,
        /// Let the key expire after this many days; without this flag it never expires
        #[arg(long, value_name = "DAYS")]
        expires_days: Option<u32>,
        /// Limit the key to N requests per minute
        #[arg(long, value_name = "N")]
        requests_per_minute: Option<u32>,
        /// Limit request bodies to N bytes per minute
        #[arg(long, value_name = "N")]
        bytes_per_minute: Option<u64>,
    },
    /// List keys, including revoked ones
    List,
    /// Revoke a key permanently
    Revoke {
        /// Id of the key, which is its middle part, or the whole key
        #[arg(value_parser = key_id)]
        id: String,
    },
}

#[derive(Deserialize)]
struct KeyList {
    keys: Vec<ApiKey>,
}

/// The keys of a running server, or those in a data folder.
enum KeyRing {
    Server(Client),
    Folder(Keys),
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let keys = KeyRing::open(&args).await?;
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
            let made = keys.create(NewKey { name, role, maps, limits, expires_days }).await?;
            match args.json {
                true => println!("{}", serde_json::to_string(&made)?),
                false => {
                    println!("{}", made.token);
                    eprintln!(
                        "created key {} ({:?}, role {}). Store it now: it is not shown again. Programs send \
                         it as \"Authorization: Bearer …\"; these commands read it from WHEREABOUTS_API_KEY",
                        made.key.id, made.key.name, made.key.role
                    );
                }
            }
        }
        Action::List => {
            let keys = keys.list().await?;
            match args.json {
                true => println!("{}", serde_json::json!({ "keys": keys })),
                false => print(&keys),
            }
        }
        Action::Revoke { id } => {
            let key = keys.revoke(&id).await?;
            match args.json {
                true => println!("{}", serde_json::to_string(&key)?),
                false => println!("{}: revoked", key.id),
            }
        }
    }
    Ok(())
}

impl KeyRing {
    async fn open(args: &Args) -> anyhow::Result<Self> {
        let Some(data) = &args.data else { return Ok(Self::Server(args.server.client()?)) };
        let flags = Overrides::default().data(Some(data.clone()));
        let config = Config::load(args.config.as_deref(), &flags)?;
        let is_new = !config.database.is_set() && !config.data.dir.join("version").exists();
        if is_new && !matches!(args.action, Action::Create { .. }) {
            bail!(
                "{} is not a data folder; name another one, or create the first key in it with `whereabouts \
                 keys create`",
                config.data.dir.display()
            );
        }
        let opening =
            tokio::task::spawn_blocking(move || startup::open_store(&config, Uuid::now_v7()));
        let opened = opening.await.context("cannot open the data folder")?.context(
            "cannot open the data folder; while its server runs, leave --data out to use the HTTP API",
        )?;
        Ok(Self::Folder(Keys::load(opened.store).await?))
    }

    async fn create(&self, new_key: NewKey) -> anyhow::Result<MadeKey> {
        match self {
            Self::Folder(keys) => Ok(keys.create(new_key).await?),
            Self::Server(client) => client.json(client.post("/keys").json(&new_key)).await,
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

/// Takes the id out of a key or checks that it is one, because it becomes part of a URL.
fn key_id(text: &str) -> Result<String, String> {
    Token::id_of(text).map(str::to_owned).ok_or_else(|| {
        format!("a key id has {} hexadecimal digits; `whereabouts keys list` shows them", Token::ID)
    })
}

fn print(keys: &[ApiKey]) {
    if keys.is_empty() {
        println!("no keys; create one with `whereabouts keys create`");
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
