//! The records in sled, and how they are keyed.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use uuid::Uuid;

use super::super::{JobRecord, StoreError};
use crate::domain::{Digest, Image, ImageId, Job, JobState, Map, Priority};

/// The sled trees. Clones share them.
#[derive(Clone)]
pub(super) struct Trees {
    db: sled::Db,
    /// Map name → [`Map`].
    pub maps: sled::Tree,
    /// Map uid, image id → [`StoredImage`].
    pub images: sled::Tree,
    /// Digest, owner → nothing: who needs which image bytes.
    pub blob_refs: sled::Tree,
    /// Job id → [`JobRecord`].
    pub jobs: sled::Tree,
    /// Place in the queue → when its lease ends ([`Lease`]), for jobs that have not ended.
    pub queue: sled::Tree,
    /// Cache key → description of a pair.
    pub descriptions: sled::Tree,
    /// Map uid, query id → a frame whose pairs were described.
    pub frames: sled::Tree,
    /// Day, map → what was spent.
    pub usage: sled::Tree,
}

/// The key of the number of the last commit, in the default tree.
const COMMITS: &[u8] = b"commits";

/// An image and where its descriptor is.
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub(super) struct StoredImage {
    pub image: Image,
    pub slot: usize,
}

/// Until when nobody may take a job: it is held, or is not to be tried before. `None` while it
/// waits.
pub(super) type Lease = Option<jiff::Timestamp>;

/// Who needs the bytes of a blob.
pub(super) enum BlobOwner<'a> {
    Image { map_uid: Uuid, id: &'a ImageId },
    Query(Uuid),
}

impl Trees {
    pub fn open(path: &Path, cache_bytes: u64) -> Result<Self, StoreError> {
        let db = sled::Config::new()
            .path(path)
            .cache_capacity(cache_bytes)
            // The writer flushes; a flush by the clock would only split what belongs together.
            .flush_every_ms(None)
            .open()
            .map_err(failed)?;
        let tree = |name: &str| db.open_tree(name).map_err(failed);
        Ok(Self {
            maps: tree("maps")?,
            images: tree("images")?,
            blob_refs: tree("blob_refs")?,
            jobs: tree("jobs")?,
            queue: tree("queue")?,
            descriptions: tree("descriptions")?,
            frames: tree("frames")?,
            usage: tree("usage")?,
            db,
        })
    }

    /// Makes every change so far durable.
    pub fn flush(&self) -> Result<(), StoreError> {
        self.db.flush().map(drop).map_err(failed)
    }

    /// The number of the last commit; 0 in a new database.
    pub fn commit_number(&self) -> Result<u64, StoreError> {
        Ok(get(&self.db, COMMITS)?.unwrap_or(0))
    }

    pub fn set_commit_number(&self, number: u64) -> Result<(), StoreError> {
        put(&self.db, COMMITS, &number)
    }

    pub fn maps(&self) -> Result<Vec<Map>, StoreError> {
        self.maps.iter().values().map(|value| decode(&value.map_err(failed)?)).collect()
    }

    pub fn image(&self, map_uid: Uuid, id: &ImageId) -> Result<Option<StoredImage>, StoreError> {
        get(&self.images, &image_key(map_uid, id))
    }

    /// The images of a map, by id.
    pub fn images_of(
        &self,
        map_uid: Uuid,
    ) -> impl Iterator<Item = Result<StoredImage, StoreError>> + use<> {
        self.images
            .scan_prefix(map_uid.as_bytes())
            .values()
            .map(|value| decode(&value.map_err(failed)?))
    }

    /// Forgets the frames of a map whose pairs were described.
    pub fn forget_frames(&self, map_uid: Uuid) -> Result<(), StoreError> {
        for key in self.frames.scan_prefix(map_uid.as_bytes()).keys() {
            self.frames.remove(key.map_err(failed)?).map_err(failed)?;
        }
        Ok(())
    }

    /// Images of a map by id: those after `after`.
    pub fn images_after(
        &self,
        map_uid: Uuid,
        after: Option<&ImageId>,
    ) -> impl Iterator<Item = Result<StoredImage, StoreError>> + use<> {
        let start = match after {
            // The smallest key behind the cursor's.
            Some(id) => [image_key(map_uid, id), vec![0]].concat(),
            None => map_uid.as_bytes().to_vec(),
        };
        self.images
            .range(start..)
            .take_while(move |entry| {
                entry.as_ref().map_or(true, |(key, _)| key.starts_with(map_uid.as_bytes()))
            })
            .map(|entry| decode(&entry.map_err(failed)?.1))
    }

    pub fn job(&self, id: Uuid) -> Result<Option<JobRecord>, StoreError> {
        get(&self.jobs, id.as_bytes())
    }

    /// Whether nobody needs the bytes of `digest` any more.
    pub fn is_unreferenced(&self, digest: &Digest) -> bool {
        self.blob_refs.scan_prefix(digest.hex()).next().is_none()
    }

    /// Gives every claimed job back to the queue: whoever held it ended with the last process.
    /// Returns how many jobs wait.
    pub fn requeue_claimed(&self) -> Result<usize, StoreError> {
        let mut waiting = 0;
        for key in self.queue.iter().keys() {
            let key = key.map_err(failed)?;
            waiting += 1;
            // Before there were priorities, a job's place was its id.
            let before = Uuid::from_slice(&key).ok();
            let job = before.or_else(|| queued_job(&key));
            let Some(mut record) = job.map(|id| self.job(id)).transpose()?.flatten() else {
                continue;
            };
            if record.job.state == JobState::Running {
                record.job.state = JobState::Queued;
                put(&self.jobs, record.job.id.as_bytes(), &record)?;
                put(&self.queue, &key, &Lease::None)?;
            }
            if before.is_some() {
                put(&self.queue, &queue_key(&record.job), &Lease::None)?;
                self.queue.remove(&key).map_err(failed)?;
            }
        }
        self.flush()?;
        Ok(waiting)
    }
}

/// A job's place in the queue: sorted by priority, then by age.
pub(super) fn queue_key(job: &Job) -> [u8; 17] {
    let mut key = [0; 17];
    key[0] = match job.priority {
        Priority::High => 0,
        Priority::Normal => 1,
        Priority::Low => 2,
    };
    key[1..].copy_from_slice(job.id.as_bytes());
    key
}

/// The job at a place in the queue.
pub(super) fn queued_job(key: &[u8]) -> Option<Uuid> {
    Uuid::from_slice(key.get(1..)?).ok()
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
    }
    key
}

pub(super) fn get<T: DeserializeOwned>(
    tree: &sled::Tree,
    key: &[u8],
) -> Result<Option<T>, StoreError> {
    tree.get(key).map_err(failed)?.map(|value| decode(&value)).transpose()
}

pub(super) fn put<T: Serialize>(
    tree: &sled::Tree,
    key: &[u8],
    value: &T,
) -> Result<(), StoreError> {
    tree.insert(key, encode(value)?).map(drop).map_err(failed)
}

pub(super) fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, StoreError> {
    serde_json::to_vec(value).map_err(|error| StoreError::Failed(error.to_string()))
}

pub(super) fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, StoreError> {
    serde_json::from_slice(bytes).map_err(|error| {
        StoreError::Damaged(format!("a record cannot be read ({error}); restore a backup"))
    })
}

pub(super) fn failed(error: sled::Error) -> StoreError {
    StoreError::Failed(error.to_string())
}

/// What a transaction that never aborts on its own account returns when it fails.
pub(super) fn transaction_failed(error: sled::transaction::TransactionError<()>) -> StoreError {
    match error {
        sled::transaction::TransactionError::Abort(()) => {
            StoreError::Failed("a transaction was given up".into())
        }
        sled::transaction::TransactionError::Storage(error) => failed(error),
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::domain::{MediaType, RefinerKind};
    use crate::store::Query;

    #[test]
    fn a_job_that_was_queued_before_there_were_priorities_keeps_its_place() {
        let dir = tempfile::tempdir().unwrap();
        let trees = Trees::open(dir.path(), 1 << 20).unwrap();
        let (now, query) = (Timestamp::now(), Uuid::now_v7());
        let mut job = Job::queued("m".parse().unwrap(), query, RefinerKind::Local, now);
        job.state = JobState::Running;
        let digest = Digest::of(b"frame");
        let query = Query {
            id: query,
            digest,
            media_type: MediaType::Jpeg,
            created_at: now,
            descriptor: None,
        };
        let record = JobRecord {
            job: job.clone(),
            map_uid: Uuid::nil(),
            revision: 0,
            query,
            candidates: vec![],
            claims: 0,
        };
        put(&trees.jobs, job.id.as_bytes(), &record).unwrap();
        put(&trees.queue, job.id.as_bytes(), &Some(now)).unwrap();
        for _ in 0..2 {
            assert_eq!(trees.requeue_claimed().unwrap(), 1);
            let keys: Vec<_> = trees.queue.iter().keys().map(Result::unwrap).collect();
            assert_eq!(keys, [queue_key(&job)]);
            assert_eq!(trees.job(job.id).unwrap().unwrap().job.state, JobState::Queued);
        }
    }
}
