//! Jobs: look at them, wait for them, cancel and retry them.

use std::time::Duration;

use bytes::Bytes;
use jiff::Timestamp;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;
use uuid::Uuid;

use super::images::page_size;
use super::{Service, ServiceError};
use whereabouts_api::{ErrorKind, JobPage, PairRegions};
use whereabouts_core::{ImageId, Job, MediaType, PairRegion};
use whereabouts_refine::{RefineError, RefineInput, RegionMatcher};
use whereabouts_store::{JobFilter, JobList, JobRecord};

/// The longest text that jobs are searched for, in characters.
const LONGEST_SEARCH: usize = 200;

impl Service {
    /// One job, at once or when it has ended, but after `wait` at the latest.
    pub async fn get_job(&self, id: Uuid, wait: Option<Duration>) -> Result<Job, ServiceError> {
        match wait {
            Some(wait) if wait > self.settings.max_wait => Err(ServiceError::unprocessable(
                format!("wait must be at most {} seconds", self.settings.max_wait.as_secs()),
            )),
            Some(wait) => self.wait_for(id, wait).await,
            None => self.known_job(id).await,
        }
    }

    /// Jobs, newest first, a page at a time. A search for a text ends its page early once it has looked at
    /// as many jobs as the store looks at in one go.
    pub async fn list_jobs(
        &self,
        filter: JobFilter,
        cursor: Option<Uuid>,
        limit: Option<usize>,
    ) -> Result<JobPage, ServiceError> {
        let limit = page_size(limit)?;
        let _turn = match filter.text {
            Some(_) => Some(self.searching.acquire().await),
            None => None,
        };
        let JobList { mut jobs, searched_to } = self.jobs.jobs(&filter, cursor, limit + 1).await?;
        let more = jobs.len() > limit;
        jobs.truncate(limit);
        let next_cursor = jobs.last().filter(|_| more).map(|job| job.id).or(searched_to);
        Ok(JobPage { jobs, next_cursor })
    }

    /// Cancels a job; one that has ended stays as it is.
    pub async fn cancel_job(&self, id: Uuid) -> Result<Job, ServiceError> {
        Ok(self.jobs.cancel(id).await?)
    }

    /// Queues a job again that ended without success.
    pub async fn retry_job(&self, id: Uuid) -> Result<Job, ServiceError> {
        Ok(self.jobs.retry(id).await?)
    }

    /// Jobs that wait or run.
    pub async fn open_jobs(&self) -> Result<usize, ServiceError> {
        Ok(self.jobs.queued().await?)
    }

    /// How long ago the oldest of them was submitted; zero, if there is none.
    pub async fn age_of_oldest_job(&self) -> Result<Duration, ServiceError> {
        let submitted = self.jobs.oldest_unfinished().await?;
        let age = submitted.map(|submitted| Timestamp::now().duration_since(submitted));
        // The clock of whoever submitted it may be ahead.
        Ok(age.and_then(|age| age.try_into().ok()).unwrap_or_default())
    }

    /// The frame of a job: as it was sent, or as a JPEG no larger than `max_edge` pixels.
    pub async fn frame_of(
        &self,
        id: Uuid,
        max_edge: Option<u32>,
    ) -> Result<(MediaType, Bytes), ServiceError> {
        let query = self.jobs.job(id).await?.ok_or_else(|| no_job(id))?.query;
        let bytes = self.blobs.blob(&query.digest).await?.ok_or_else(|| {
            ServiceError::not_found(format!("the frame of the job {id} is no longer there"))
        })?;
        self.shown(query.media_type, bytes, max_edge).await
    }

    /// The regions that a job's frame and one of its candidates have in common, if its refiner compares
    /// regions. They are compared anew, with the pictures as they are now.
    pub async fn matches(&self, id: Uuid, image: &ImageId) -> Result<PairRegions, ServiceError> {
        let record = self.jobs.job(id).await?.ok_or_else(|| no_job(id))?;
        let refiner = self.refiner.as_ref().filter(|refiner| refiner.kind() == record.job.refiner);
        let _turn = self.matching.acquire().await;
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
                "the job {id} has no matches with {image}: it is not among its candidates any more, or the \
                 refiner is not the one that compares regions (local)"
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
        let input = RefineInput::of_job(record, self.maps.as_ref()).await?;
        matcher.regions(&input, image).await
    }

    /// Waits until the job has ended, but no longer than `longest`; the job as it then is.
    pub(super) async fn wait_for(&self, id: Uuid, longest: Duration) -> Result<Job, ServiceError> {
        let mut changes = self.jobs.changes();
        let ended = async {
            loop {
                let job = self.known_job(id).await?;
                if job.state.is_final() {
                    return Ok(job);
                }
                // Other jobs change too; only this one's change is worth a look.
                while next_change(&mut changes).await?.is_some_and(|changed| changed != id) {}
            }
        };
        match tokio::time::timeout(longest, ended).await {
            Ok(job) => job,
            Err(_) => self.known_job(id).await,
        }
    }

    async fn known_job(&self, id: Uuid) -> Result<Job, ServiceError> {
        match self.jobs.job(id).await? {
            Some(record) => Ok(record.job),
            None => Err(no_job(id)),
        }
    }
}

/// What jobs are searched for, if for anything.
pub fn search_text(text: &str) -> Result<Option<String>, ServiceError> {
    let length = text.chars().count();
    if length > LONGEST_SEARCH {
        return Err(ServiceError::malformed(format!(
            "the text to search for has {length} characters; {LONGEST_SEARCH} are the most"
        )));
    }
    Ok(Some(text.trim()).filter(|text| !text.is_empty()).map(str::to_owned))
}

/// The id of a job, or of another thing, that a text is.
pub fn uuid(of: &str, text: &str) -> Result<Uuid, ServiceError> {
    text.parse().map_err(|_| {
        let shown: String = text.chars().take(80).collect();
        ServiceError::malformed(format!("a {of} id is a UUID; got {shown:?}"))
    })
}

pub(super) fn no_job(id: Uuid) -> ServiceError {
    ServiceError::not_found(format!(
        "there is no job {id}; one that has ended is removed in time (jobs.keep_days, \
         jobs.keep_count)"
    ))
}

/// The next job that changes; `None` if notices were lost, any of which may have been the one.
async fn next_change(changes: &mut Receiver<Uuid>) -> Result<Option<Uuid>, ServiceError> {
    match changes.recv().await {
        Ok(id) => Ok(Some(id)),
        Err(RecvError::Lagged(_)) => Ok(None),
        Err(RecvError::Closed) => {
            Err(ServiceError::new(ErrorKind::Unavailable, "the store has been closed"))
        }
    }
}
