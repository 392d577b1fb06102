//! The embedded store: one folder, one process.
//!
//! ```text
//! DATA/lock              held while a process uses the folder
//! DATA/version           the version of what follows (`schema.rs`)
//! DATA/commits           the number of the last commit, to notice a database that lost some
//! DATA/db/               sled: records of maps, images, queries and jobs
//! DATA/descriptors/UID/  append-only segments of one map's descriptors, memory-mapped; UID-N/ from
//!                        its Nth reindex on
//! DATA/images/ab/…       image bytes by digest
//! ```
//!
//! One writer thread applies every change and makes those that arrived together durable together.
//! The graph of a map is derived from its segments and is built in the background.

mod answers;
mod blobs;
mod compact;
mod descriptions;
mod doctor;
mod drafts;
mod export;
mod indexer;
mod jobs;
mod keys;
mod live_map;
mod maps;
mod mark;
mod retention;
mod schema;
mod segments;
mod trees;
mod usage;
mod webhooks;
mod writer;

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;

use parking_lot::RwLock;
use tokio::sync::{broadcast, watch};
use uuid::Uuid;

use self::blobs::Blobs;
pub use self::compact::{Compacted, compact};
use self::descriptions::DescriptionUse;
pub use self::doctor::{Examination, Finding, MapReport, Report, Sizes, examine};
use self::indexer::Indexer;
use self::live_map::LiveMap;
use self::mark::CommitWatermark;
use self::trees::Trees;
use self::writer::Writer;
use super::{DescriptionBounds, StoreError};
use whereabouts_core::MapName;
use whereabouts_index::IndexSettings;

/// How the embedded store works.
#[derive(Debug, Clone)]
pub struct EmbeddedSettings {
    /// Its folder; made if it is not there.
    pub dir: PathBuf,
    /// How maps are indexed.
    pub index: IndexSettings,
    /// Threads that build graphs.
    pub index_threads: usize,
    /// Bytes of the disk that stay free.
    pub min_free_bytes: u64,
    /// Memory for sled's page cache, in bytes.
    pub db_cache_bytes: u64,
    /// The most changes that are made durable together.
    pub commit_batch: usize,
    /// Bounds of the cache of descriptions.
    pub descriptions: DescriptionBounds,
}

/// The embedded store; clones share it.
#[derive(Clone)]
pub struct EmbeddedStore {
    inner: Arc<Inner>,
}

struct Inner {
    trees: Trees,
    writer: Writer,
    blobs: Blobs,
    maps: RwLock<BTreeMap<MapName, Arc<LiveMap>>>,
    /// Descriptors in the making, by the uid of their map.
    drafts: RwLock<BTreeMap<Uuid, Arc<LiveMap>>>,
    indexer: Indexer,
    index: IndexSettings,
    descriptors: PathBuf,
    /// Jobs that wait or run, and jobs that have ended.
    queued: AtomicUsize,
    ended: AtomicUsize,
    descriptions: DescriptionUse,
    changes: broadcast::Sender<Uuid>,
    /// Told when deliveries to webhooks were queued.
    deliveries: watch::Sender<()>,
    /// Held, never read: the lock ends with the file handle.
    _lock: File,
}

/// Change notices kept for a slow listener.
const CHANGES_KEPT: usize = 1024;

impl EmbeddedStore {
    /// Opens the store and loads every map. Blocks; call it before serving.
    pub fn open(settings: &EmbeddedSettings) -> Result<Self, StoreError> {
        let dir = &settings.dir;
        make_folder(dir)?;
        let lock = lock(dir)?;
        schema::bring_up_to_date(dir)?;
        compact::settle(dir)?;
        let trees = Trees::open(&dir.join("db"), settings.db_cache_bytes)?;
        let mark = CommitWatermark::open(dir, &trees)?;
        let descriptors = dir.join("descriptors");
        make_folder(&descriptors)?;
        let blobs = Blobs::open(dir.join("images"), settings.min_free_bytes)?;
        maps::sweep_deleted(&trees, &blobs, &descriptors)?;
        let mut loaded = BTreeMap::new();
        for map in trees.maps()? {
            let name = map.name.clone();
            let live = LiveMap::load(map, &descriptors, settings.index, &trees)?;
            loaded.insert(name, Arc::new(live));
        }
        let queued = trees.requeue_claimed()?;
        let ended = trees.ended.len();
        let inner = Inner {
            writer: Writer::start(trees.clone(), mark, settings.commit_batch)?,
            indexer: Indexer::start(settings.index_threads)?,
            descriptions: DescriptionUse::load(&trees, settings.descriptions)?,
            trees,
            blobs,
            maps: RwLock::new(loaded),
            drafts: RwLock::default(),
            index: settings.index,
            descriptors,
            queued: AtomicUsize::new(queued),
            ended: AtomicUsize::new(ended),
            changes: broadcast::channel(CHANGES_KEPT).0,
            deliveries: watch::Sender::new(()),
            _lock: lock,
        };
        for live in inner.maps.read().values() {
            inner.indexer.look_at(live);
        }
        Ok(Self { inner: Arc::new(inner) })
    }
}

fn make_folder(path: &Path) -> Result<(), StoreError> {
    std::fs::create_dir_all(path).map_err(|error| {
        StoreError::Failed(format!(
            "cannot make the folder {}: {error}; choose another with --data",
            path.display()
        ))
    })
}

/// A folder that is to be looked at, not made.
fn check_folder(dir: &Path) -> Result<(), StoreError> {
    if dir.is_dir() {
        return Ok(());
    }
    let dir = dir.display();
    Err(StoreError::NotFound(format!("there is no data folder {dir}; name one with --data")))
}

fn lock(dir: &Path) -> Result<File, StoreError> {
    let path = dir.join("lock");
    let file =
        File::options().create(true).truncate(false).write(true).open(&path).map_err(|error| {
            StoreError::Failed(format!("cannot write {}: {error}", path.display()))
        })?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(StoreError::Conflict(format!(
            "another process uses the data folder {}; stop it first, or choose another with --data",
            dir.display()
        ))),
        Err(TryLockError::Error(error)) => {
            Err(StoreError::Failed(format!("cannot lock {}: {error}", path.display())))
        }
    }
}

/// Runs a read that may touch the disk away from the async threads.
async fn blocking<T, F>(work: F) -> Result<T, StoreError>
where
    T: Send + 'static,
    F: FnOnce() -> Result<T, StoreError> + Send + 'static,
{
    tokio::task::spawn_blocking(work)
        .await
        .unwrap_or_else(|error| Err(StoreError::Failed(format!("a read broke off: {error}"))))
}
