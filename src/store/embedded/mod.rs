//! The embedded store, for a single process: everything is in one data folder.
//!
//! ```text
//! DATA/lock              held while a process uses the folder
//! DATA/version           the version of the folder's format (`schema.rs`)
//! DATA/commits           the number of the last commit, to detect a database that lost commits
//! DATA/db/               sled: records of maps, images, queries and jobs
//! DATA/descriptors/UID/  append-only segments of one map's descriptors, memory-mapped; UID-N/ from
//!                        its Nth reindex on
//! DATA/images/ab/…       image bytes by digest
//! DATA/tracks/UID/       the tracks of robots in one map, which may be lost with the machine
//! ```
//!
//! A single writer thread applies all changes and makes them durable by group commit. The graph of a
//! map is derived from its segments and is built in the background.

mod blobs;
mod compact;
mod corrections;
mod descriptions;
mod doctor;
mod drafts;
mod export;
mod idempotency;
mod images;
mod indexer;
mod jobs;
mod keys;
mod live_map;
mod maps;
mod orphans;
mod records;
mod retention;
mod schema;
mod segments;
#[cfg(test)]
mod test_records;
mod texts;
mod tracks;
mod trees;
mod usage;
mod watermark;
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
use self::descriptions::DescriptionLru;
pub use self::doctor::{Examination, Finding, MapReport, Report, Sizes, examine};
use self::indexer::Indexer;
use self::live_map::LiveMap;
use self::tracks::TrackFiles;
use self::trees::Trees;
use self::watermark::CommitWatermark;
use self::writer::Writer;
use super::{DescriptionBounds, StoreError};
use whereabouts_core::MapName;
use whereabouts_index::IndexSettings;

/// Settings of the embedded store.
#[derive(Debug, Clone)]
pub struct EmbeddedSettings {
    /// The data folder, created if it does not exist.
    pub dir: PathBuf,
    /// How maps are indexed.
    pub index: IndexSettings,
    /// Threads that build graphs.
    pub index_threads: usize,
    /// Free disk space below which no image bytes are stored.
    pub min_free_bytes: u64,
    /// Size of sled's page cache, in bytes.
    pub db_cache_bytes: u64,
    /// Maximum number of changes in a group commit.
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
    /// Drafts, by the uid of their map.
    drafts: RwLock<BTreeMap<Uuid, Arc<LiveMap>>>,
    indexer: Indexer,
    index: IndexSettings,
    descriptors: PathBuf,
    /// Number of jobs that are queued or running.
    queued: AtomicUsize,
    /// Number of jobs that have ended.
    ended: AtomicUsize,
    descriptions: DescriptionLru,
    tracks: TrackFiles,
    changes: broadcast::Sender<Uuid>,
    /// Notified when deliveries to webhooks were queued.
    deliveries: watch::Sender<()>,
    /// Locks the data folder for as long as the file is open.
    _lock: File,
}

/// Capacity of the channel of job changes; a slower receiver misses the oldest.
const CHANGES_CAPACITY: usize = 1024;

impl EmbeddedStore {
    /// Opens the store and loads every map. This blocks, so call it before serving.
    pub fn open(settings: &EmbeddedSettings) -> Result<Self, StoreError> {
        let dir = &settings.dir;
        create_folder(dir)?;
        let lock = lock(dir)?;
        schema::bring_up_to_date(dir)?;
        compact::finish_interrupted(dir)?;
        let trees = Trees::open(&dir.join("db"), settings.db_cache_bytes)?;
        let watermark = CommitWatermark::open(dir, &trees)?;
        let descriptors = dir.join("descriptors");
        create_folder(&descriptors)?;
        let blobs = Blobs::open(dir.join("images"), settings.min_free_bytes)?;
        orphans::collect_orphans(&trees, &blobs, &descriptors)?;
        let mut loaded = BTreeMap::new();
        let maps = trees.maps()?;
        let tracks = TrackFiles::open(dir.join("tracks"), &maps)?;
        for map in maps {
            let name = map.name.clone();
            let live = LiveMap::load(map, &descriptors, settings.index, &trees)?;
            loaded.insert(name, Arc::new(live));
        }
        let queued = trees.requeue_claimed()?;
        let ended = trees.ended.len();
        let inner = Inner {
            writer: Writer::start(trees.clone(), watermark, settings.commit_batch)?,
            indexer: Indexer::start(settings.index_threads)?,
            descriptions: DescriptionLru::load(&trees, settings.descriptions)?,
            tracks,
            trees,
            blobs,
            maps: RwLock::new(loaded),
            drafts: RwLock::default(),
            index: settings.index,
            descriptors,
            queued: AtomicUsize::new(queued),
            ended: AtomicUsize::new(ended),
            changes: broadcast::channel(CHANGES_CAPACITY).0,
            deliveries: watch::Sender::new(()),
            _lock: lock,
        };
        for live in inner.maps.read().values() {
            inner.indexer.notify(live);
        }
        Ok(Self { inner: Arc::new(inner) })
    }
}

fn create_folder(path: &Path) -> Result<(), StoreError> {
    std::fs::create_dir_all(path).map_err(|error| {
        StoreError::Failed(format!(
            "cannot create the folder {}: {error}; choose another with --data",
            path.display()
        ))
    })
}

/// Refuses a data folder that does not exist, without creating it.
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

/// Runs a read that may touch the disk outside the async threads.
async fn blocking<T, F>(read: F) -> Result<T, StoreError>
where
    T: Send + 'static,
    F: FnOnce() -> Result<T, StoreError> + Send + 'static,
{
    tokio::task::spawn_blocking(read)
        .await
        .unwrap_or_else(|error| Err(StoreError::Failed(format!("a read did not finish: {error}"))))
}
