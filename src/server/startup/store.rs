//! Opens the store that is configured: PostgreSQL if `database.url` is set, else the embedded one.

use std::sync::Arc;
use std::time::Duration;

use uuid::Uuid;
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::{DescriptionBounds, SharedLimits, Store};

#[cfg(feature = "postgres")]
pub use self::scale_out::postgres_settings;
use crate::config::Config;

/// A store and the limits that come with it.
pub struct OpenStore {
    /// The store.
    pub store: Arc<dyn Store>,
    /// Limits that all processes share; `None` for a store that belongs to this process.
    pub shared: Option<Arc<dyn SharedLimits>>,
}

/// Opens the configured store for the process with this id. Blocks.
pub fn open_store(config: &Config, process: Uuid) -> anyhow::Result<OpenStore> {
    match config.database.is_set() {
        true => scale_out::open(config, process),
        false => Ok(OpenStore { store: Arc::new(embedded(config)?), shared: None }),
    }
}

/// Opens the embedded store, which belongs to one process.
fn embedded(config: &Config) -> anyhow::Result<EmbeddedStore> {
    Ok(EmbeddedStore::open(&EmbeddedSettings {
        dir: config.data.dir.clone(),
        index: config.index,
        index_threads: config.index.build_threads(),
        min_free_bytes: config.data.min_free_bytes,
        db_cache_bytes: config.data.db_cache_bytes,
        commit_batch: config.data.commit_batch,
        descriptions: descriptions(config),
    })?)
}

fn descriptions(config: &Config) -> DescriptionBounds {
    DescriptionBounds {
        max_bytes: config.data.description_cache_bytes,
        max_age: Duration::from_secs(config.data.description_cache_days * 24 * 3600),
    }
}

#[cfg(feature = "postgres")]
mod scale_out {
    use tokio::runtime::Handle;
    use whereabouts_store::postgres::{PostgresSettings, PostgresStore};
    use whereabouts_store::{ObjectSettings, Objects};

    use super::*;

    pub fn open(config: &Config, process: Uuid) -> anyhow::Result<OpenStore> {
        let opening = PostgresStore::open(postgres_settings(config), objects(config)?, process);
        let store = Arc::new(Handle::current().block_on(opening)?);
        Ok(OpenStore { store: store.clone(), shared: Some(store) })
    }

    /// Settings of the store in PostgreSQL.
    pub fn postgres_settings(config: &Config) -> PostgresSettings {
        let database = &config.database;
        PostgresSettings {
            url: database.url.expose().to_owned(),
            max_connections: database.max_connections,
            timeout: database.timeout(),
            lifetime: Duration::from_secs(database.lifetime_s),
            pin: Duration::from_secs(config.objects.keep_unneeded_s),
            index: config.index,
            index_memory_mib: database.index_memory_mib,
            descriptions: descriptions(config),
        }
    }

    fn objects(config: &Config) -> anyhow::Result<Objects> {
        let objects = &config.objects;
        if objects.url.is_empty() {
            return Ok(Objects::folder(&config.data.dir.join("images"), objects.timeout())?);
        }
        Ok(Objects::open(&ObjectSettings {
            url: objects.url.clone(),
            endpoint: objects.endpoint.clone(),
            region: objects.region.clone(),
            allow_http: objects.allow_http,
            timeout: objects.timeout(),
        })?)
    }
}

/// What a build without PostgreSQL answers.
#[cfg(not(feature = "postgres"))]
mod scale_out {
    use super::*;

    pub fn open(_: &Config, _: Uuid) -> anyhow::Result<OpenStore> {
        anyhow::bail!(
            "database.url is set, but this build cannot use PostgreSQL: build with the Cargo feature `postgres`, \
             or leave the setting empty"
        )
    }
}
