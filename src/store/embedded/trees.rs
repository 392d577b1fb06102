//! The records in sled and their keys.

use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use uuid::Uuid;

use super::super::changes::queue_rank;
use super::super::{JobRecord, StoreError};
pub(super) use super::records::{decode, encode, failed, get, put, transaction_failed};
use super::webhooks::trees::WebhookTrees;
use whereabouts_core::{Digest, ImageId, Job, JobState, Map};

/// The sled trees. Clones share the same database.
#[derive(Clone)]
pub(super) struct Trees {
    db: sled::Db,
    /// Map name → [`Map`].
    pub maps: sled::Tree,
    /// Map uid, image id → [`StoredImage`](super::images::StoredImage).
    pub images: sled::Tree,
    /// Map uid, slot → [`Entry`](super::images::Entry).
    pub slots: sled::Tree,
    /// Map uid, image id → what was read in it.
    pub texts: sled::Tree,
    /// Map uid, gram, image id → nothing: the images in whose texts a gram occurs.
    pub text_grams: sled::Tree,
    /// Map uid → how often poses of its images were changed.
    pub moves: sled::Tree,
    /// Digest, owner → nothing: the references to image bytes.
    pub blob_refs: sled::Tree,
    /// Job id → [`JobRecord`].
    pub jobs: sled::Tree,
    /// Priority, job id → when its lease ends ([`Lease`]), for jobs that have not ended.
    pub queue: sled::Tree,
    /// End time, job id → nothing, for jobs that have ended.
    pub ended: sled::Tree,
    /// Cache key → description of a pair.
    pub descriptions: sled::Tree,
    /// Map uid, query id → a frame whose pairs were described.
    pub frames: sled::Tree,
    /// Day, map → usage.
    pub usage: sled::Tree,
    /// Id → API key.
    pub keys: sled::Tree,
    /// Caller and idempotency key → idempotency record.
    pub answers: sled::Tree,
    /// Time of that record, the same key → nothing.
    pub answers_by_age: sled::Tree,
    /// Webhooks and their deliveries.
    pub webhooks: WebhookTrees,
}

/// The key of the commit number in the default tree.
const COMMITS: &[u8] = b"commits";

/// How long [`open_when_released`] waits for the lock.
const LOCK_TIMEOUT: Duration = Duration::from_secs(10);

/// Opens the database, waiting for sled's own threads to release its lock.
///
/// A database that this process has just closed, for example after a migration, stays locked until
/// the last task in sled's thread pool has ended, and sled has no call that waits for that. No other
/// process can hold the lock, because the lock of the data folder is taken first.
fn open_when_released(config: &sled::Config) -> sled::Result<sled::Db> {
    let deadline = Instant::now() + LOCK_TIMEOUT;
    loop {
        match config.open() {
            Err(sled::Error::Io(error))
                if error.to_string().contains("could not acquire lock")
                    && Instant::now() < deadline =>
            {
                thread::sleep(Duration::from_millis(5));
            }
            result => return result,
        }
    }
}

/// The moment before which a job cannot be claimed, because a worker holds it or its retry is delayed.
/// `None` while it waits.
pub(super) type Lease = Option<Timestamp>;

/// A record that refers to the bytes of a blob.
pub(super) enum BlobOwner<'a> {
    Image {
        map_uid: Uuid,
        id: &'a ImageId,
    },
    Query(Uuid),
    /// The vocabulary of a map.
    Vocabulary(Uuid),
}

impl Trees {
    pub fn open(path: &Path, cache_bytes: u64) -> Result<Self, StoreError> {
        let config = sled::Config::new()
            .path(path)
            .cache_capacity(cache_bytes)
            // The writer flushes; a timed flush would split group commits.
            .flush_every_ms(None);
        let db = open_when_released(&config).map_err(failed)?;
        let tree = |name: &str| db.open_tree(name).map_err(failed);
        Ok(Self {
            maps: tree("maps")?,
            images: tree("images")?,
            slots: tree("slots")?,
            texts: tree("texts")?,
            text_grams: tree("text_grams")?,
            moves: tree("moves")?,
            blob_refs: tree("blob_refs")?,
            jobs: tree("jobs")?,
            queue: tree("queue")?,
            ended: tree("ended")?,
            descriptions: tree("descriptions")?,
            frames: tree("frames")?,
            usage: tree("usage")?,
            keys: tree("keys")?,
            answers: tree("answers")?,
            answers_by_age: tree("answers_by_age")?,
            webhooks: WebhookTrees::open(&db)?,
            db,
        })
    }

    /// Returns every tree, also those that this version does not use.
    pub fn all(&self) -> Result<Vec<sled::Tree>, StoreError> {
        self.db.tree_names().iter().map(|name| self.tree(name)).collect()
    }

    /// Returns the tree of this name, created if it does not exist.
    pub fn tree(&self, name: &[u8]) -> Result<sled::Tree, StoreError> {
        self.db.open_tree(name).map_err(failed)
    }

    /// Makes all changes so far durable.
    pub fn flush(&self) -> Result<(), StoreError> {
        self.db.flush().map(drop).map_err(failed)
    }

    /// Returns the number of the last commit; 0 in a new database.
    pub fn commit_number(&self) -> Result<u64, StoreError> {
        Ok(get(&self.db, COMMITS)?.unwrap_or(0))
    }

    pub fn set_commit_number(&self, number: u64) -> Result<(), StoreError> {
        put(&self.db, COMMITS, &number)
    }

    pub fn maps(&self) -> Result<Vec<Map>, StoreError> {
        self.maps.iter().values().map(|value| decode(&value.map_err(failed)?)).collect()
    }

    /// Returns how often poses of a map's images were changed.
    pub fn moved(&self, map_uid: Uuid) -> Result<u64, StoreError> {
        Ok(get(&self.moves, map_uid.as_bytes())?.unwrap_or(0))
    }

    /// Deletes the described frames of a map.
    pub fn forget_frames(&self, map_uid: Uuid) -> Result<(), StoreError> {
        for key in self.frames.scan_prefix(map_uid.as_bytes()).keys() {
            self.frames.remove(key.map_err(failed)?).map_err(failed)?;
        }
        Ok(())
    }

    pub fn job(&self, id: Uuid) -> Result<Option<JobRecord>, StoreError> {
        get(&self.jobs, id.as_bytes())
    }

    /// Whether no record refers to the bytes of `digest`.
    pub fn is_unreferenced(&self, digest: &Digest) -> bool {
        self.blob_refs.scan_prefix(digest.hex()).next().is_none()
    }

    /// Returns every running job to the queue, because the process that ran it has ended. Returns the
    /// number of queued jobs.
    pub fn requeue_claimed(&self) -> Result<usize, StoreError> {
        let mut queued = 0;
        for key in self.queue.iter().keys() {
            let key = key.map_err(failed)?;
            queued += 1;
            let job = queued_job(&key).map(|id| self.job(id)).transpose()?.flatten();
            let Some(mut record) = job else { continue };
            if record.job.state == JobState::Running {
                record.job.state = JobState::Queued;
                put(&self.jobs, record.job.id.as_bytes(), &record)?;
                put(&self.queue, &key, &Lease::None)?;
            }
        }
        self.flush()?;
        Ok(queued)
    }

    /// Returns the size of the database's files, in bytes.
    pub fn bytes(&self) -> Result<u64, StoreError> {
        self.db.size_on_disk().map_err(failed)
    }
}

/// The key of a job in the queue, which sorts by priority, then by age.
pub(super) fn queue_key(job: &Job) -> [u8; 17] {
    let mut key = [0; 17];
    key[0] = queue_rank(job.priority);
    key[1..].copy_from_slice(job.id.as_bytes());
    key
}

/// Returns the job of a key in the queue.
pub(super) fn queued_job(key: &[u8]) -> Option<Uuid> {
    Uuid::from_slice(key.get(1..)?).ok()
}

/// The key of an ended job, which sorts by when it ended, in milliseconds since 1970.
pub(super) fn ended_key(at: Timestamp, job: Uuid) -> [u8; 24] {
    let mut key = [0; 24];
    key[..8].copy_from_slice(&at.as_millisecond().max(0).to_be_bytes());
    key[8..].copy_from_slice(job.as_bytes());
    key
}

/// Returns the end time and the id of the job of a key in `ended`.
pub(super) fn ended_job(key: &[u8]) -> Option<(Timestamp, Uuid)> {
    let (at, job) = key.split_first_chunk::<8>()?;
    Some((Timestamp::from_millisecond(i64::from_be_bytes(*at)).ok()?, Uuid::from_slice(job).ok()?))
}

pub(super) fn image_key(map_uid: Uuid, id: &ImageId) -> Vec<u8> {
    [map_uid.as_bytes().as_slice(), id.as_str().as_bytes()].concat()
}

pub(super) fn blob_ref_key(digest: &Digest, owner: &BlobOwner<'_>) -> Vec<u8> {
    let mut key = digest.hex().into_bytes();
    match owner {
        BlobOwner::Image { map_uid, id } => {
            key.push(b'i');
            key.extend(image_key(*map_uid, id));
        }
        BlobOwner::Query(id) => {
            key.push(b'q');
            key.extend(id.as_bytes());
        }
        BlobOwner::Vocabulary(map_uid) => {
            key.push(b'v');
            key.extend(map_uid.as_bytes());
        }
    }
    key
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opening_waits_for_the_lock_of_a_database_that_was_just_closed() {
        let dir = tempfile::tempdir().unwrap();
        let first = Trees::open(dir.path(), 1 << 20).unwrap();
        let closing = thread::spawn(move || {
            thread::sleep(Duration::from_millis(100));
            drop(first);
        });
        Trees::open(dir.path(), 1 << 20).unwrap();
        closing.join().unwrap();
    }
}
