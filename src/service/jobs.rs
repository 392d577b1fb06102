//! Refinement jobs: get, wait, list, cancel and retry. Queueing them is for `submit`, their events for `events`.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use jiff::Timestamp;
use tokio::sync::Semaphore;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;
use uuid::Uuid;

use super::images::page_size;
use super::{Imaging, ServiceError};
use whereabouts_api::{ErrorKind, JobPage, PairRegions};
use whereabouts_core::{ImageId, Job, MediaType, PairRegion, RefinerKind};
use whereabouts_refine::{RefineError, RefineInput, Refiner, RegionMatcher};
use whereabouts_store::{BlobStore, JobFilter, JobList, JobRecord, JobStore};

/// Maximum length of a search text, in characters.
const MAX_SEARCH_CHARS: usize = 200;

/// Refinement jobs: get, wait, list, cancel and retry. Clones share the store.
#[derive(Clone)]
pub struct Jobs {
    /// The jobs.
    pub store: Arc<dyn JobStore>,
    /// The bytes of the frames.
    pub blobs: Arc<dyn BlobStore>,
    /// Makes thumbnails.
    pub imaging: Imaging,
    /// The refiner, if one is configured.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// Limits comparisons for display to one at a time, so that they do not slow jobs down.
    pub matching: Arc<Semaphore>,
    /// Limits text searches to one at a time: each reads many jobs.
    pub searching: Arc<Semaphore>,
    /// The longest time that a caller may wait for the end of a job.
    pub max_wait: Duration,
    /// Minimum confidence of a known place.
    pub known_confidence: f64,
}

impl Jobs {
    /// Returns a job. With `wait`, waits until it has ended, for that long at most.
    pub async fn get(&self, id: Uuid, wait: Option<Duration>) -> Result<Job, ServiceError> {
        match wait {
            Some(wait) if wait > self.max_wait => Err(ServiceError::unprocessable(format!(
                "wait must be at most {} seconds",
                self.max_wait.as_secs()
            ))),
            Some(wait) => self.wait_for(id, wait).await,
            None => self.find(id).await,
        }
    }

    /// Returns a page of jobs, newest first. A text search may end its page early, because the store bounds how
    /// many jobs one search reads.
    pub async fn list(
        &self,
        filter: JobFilter,
        cursor: Option<Uuid>,
        limit: Option<usize>,
    ) -> Result<JobPage, ServiceError> {
        let limit = page_size(limit)?;
        let _permit = match filter.text {
            Some(_) => Some(self.searching.acquire().await),
            None => None,
        };
        let JobList { mut jobs, searched_to } = self.store.jobs(&filter, cursor, limit + 1).await?;
        let more = jobs.len() > limit;
        jobs.truncate(limit);
        for job in &mut jobs {
            if job.is_unmeasured()
                && let Some(record) = self.store.job(job.id).await?
            {
                *job = self.measured(record).await.job;
            }
        }
        let next_cursor = jobs.last().filter(|_| more).map(|job| job.id).or(searched_to);
        Ok(JobPage { jobs, next_cursor })
    }

    /// Cancels a job. A job that has ended stays as it is.
    pub async fn cancel(&self, id: Uuid) -> Result<Job, ServiceError> {
        self.with_confidence(self.store.cancel(id).await?).await
    }

    /// Queues a job again that ended without success. With `fresh`, any job that has ended, and its descriptions
    /// are bought again.
    pub async fn retry(&self, id: Uuid, fresh: bool) -> Result<Job, ServiceError> {
        Ok(self.store.retry(id, fresh.then(Timestamp::now)).await?)
    }

    /// Returns the number of jobs that are queued or running.
    pub async fn open(&self) -> Result<usize, ServiceError> {
        Ok(self.store.queued().await?)
    }

    /// Returns the age of the oldest job that has not ended; zero if there is none.
    pub async fn oldest_age(&self) -> Result<Duration, ServiceError> {
        let submitted = self.store.oldest_unfinished().await?;
        let age = submitted.map(|submitted| Timestamp::now().duration_since(submitted));
        // Negative if the clock of the process that submitted it is ahead.
        Ok(age.and_then(|age| age.try_into().ok()).unwrap_or_default())
    }

    /// Returns the frame of a job as it was sent, or as a JPEG whose longer edge is at most `max_edge` pixels.
    pub async fn frame(
        &self,
        id: Uuid,
        max_edge: Option<u32>,
    ) -> Result<(MediaType, Bytes), ServiceError> {
        let query = self.store.job(id).await?.ok_or_else(|| no_job(id))?.query;
        let bytes = self.blobs.blob(&query.digest).await?.ok_or_else(|| {
            ServiceError::not_found(format!("the frame of the job {id} has been removed"))
        })?;
        self.imaging.thumbnail(query.media_type, bytes, max_edge).await
    }

    /// Returns the regions that the frame of a job shares with one of its candidates, if its refiner compares
    /// regions. They are computed on request, from the pictures as they are now.
    pub async fn matches(&self, id: Uuid, image: &ImageId) -> Result<PairRegions, ServiceError> {
        let record = self.store.job(id).await?.ok_or_else(|| no_job(id))?;
        let compares_regions = record.job.refiner != RefinerKind::Mllm;
        let refiner = self.refiner.as_ref().filter(|_| compares_regions);
        let _permit = self.matching.acquire().await;
        let regions = match refiner.and_then(|refiner| refiner.region_matcher()) {
            Some(matcher) => {
                self.regions(&record, matcher, image).await.map_err(|error| match error {
                    RefineError::Permanent(why) => ServiceError::not_found(why),
                    RefineError::Transient(why) | RefineError::Deferred { why, .. } => {
                        ServiceError::new(ErrorKind::Unavailable, why)
                    }
                })?
            }
            None => None,
        };
        let regions = regions.ok_or_else(|| {
            ServiceError::not_found(format!(
                "the job {id} has no matches with {image}: the image is no longer one of its candidates, or \
                 the refiner does not compare regions (only local and cascade do)"
            ))
        })?;
        Ok(PairRegions { regions })
    }

    async fn regions(
        &self,
        record: &JobRecord,
        matcher: &dyn RegionMatcher,
        image: &ImageId,
    ) -> Result<Option<Vec<PairRegion>>, RefineError> {
        let input = RefineInput::of_job(record, self.imaging.maps.as_ref()).await?;
        matcher.regions(&input, image).await
    }

    /// Waits until a job has ended, for `longest` at most, and returns it as it is then.
    pub(crate) async fn wait_for(&self, id: Uuid, longest: Duration) -> Result<Job, ServiceError> {
        let mut changes = self.store.changes();
        let ended = async {
            loop {
                let job = self.find(id).await?;
                if job.state.is_final() {
                    return Ok(job);
                }
                // Read the job again only after its own change, not after every other job's.
                while next_change(&mut changes).await?.is_some_and(|changed| changed != id) {}
            }
        };
        match tokio::time::timeout(longest, ended).await {
            Ok(job) => job,
            Err(_) => self.find(id).await,
        }
    }

    async fn find(&self, id: Uuid) -> Result<Job, ServiceError> {
        match self.store.job(id).await? {
            Some(record) => Ok(self.measured(record).await.job),
            None => Err(no_job(id)),
        }
    }

    /// Computes the confidences that were not measured when a job ended, if they are now.
    pub(super) async fn measured(&self, mut record: JobRecord) -> JobRecord {
        if record.job.is_unmeasured() {
            let calibration = record.calibration(self.imaging.maps.as_ref()).await;
            // Without, they stay unmeasured: the job can still be read.
            if let Ok(Some(calibration)) = calibration {
                record.job.measure(&calibration, &record.candidates, self.known_confidence);
            }
        }
        record
    }

    /// The same for a job without its record.
    async fn with_confidence(&self, job: Job) -> Result<Job, ServiceError> {
        match job.is_unmeasured() {
            true => self.find(job.id).await,
            false => Ok(job),
        }
    }
}

/// Trims a search text and checks its length; `None` if it is blank.
pub fn parse_search_text(text: &str) -> Result<Option<String>, ServiceError> {
    let length = text.chars().count();
    if length > MAX_SEARCH_CHARS {
        return Err(ServiceError::malformed(format!(
            "the search text has {length} characters; the maximum is {MAX_SEARCH_CHARS}"
        )));
    }
    Ok(Some(text.trim()).filter(|text| !text.is_empty()).map(str::to_owned))
}

/// Parses the id of a resource, whose kind `of` is named in the error.
pub fn uuid(of: &str, text: &str) -> Result<Uuid, ServiceError> {
    text.parse().map_err(|_| {
        let shown: String = text.chars().take(80).collect();
        ServiceError::malformed(format!("a {of} id is a UUID; got {shown:?}"))
    })
}

pub(super) fn no_job(id: Uuid) -> ServiceError {
    ServiceError::not_found(format!(
        "there is no job {id}; jobs that have ended are removed after a while (jobs.keep_days, \
         jobs.keep_count)"
    ))
}

/// Waits for the next change of any job and returns its id; `None` if notifications were lost, each of which may
/// have been for any job.
async fn next_change(changes: &mut Receiver<Uuid>) -> Result<Option<Uuid>, ServiceError> {
    match changes.recv().await {
        Ok(id) => Ok(Some(id)),
        Err(RecvError::Lagged(_)) => Ok(None),
        Err(RecvError::Closed) => {
            Err(ServiceError::new(ErrorKind::Unavailable, "the store has been closed"))
        }
    }
}
