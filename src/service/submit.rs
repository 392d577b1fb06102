//! Queues the refinement job of a localized frame, or says why the frame gets none. Under load, jobs are shed
//! before frames are rejected.

use std::sync::Arc;

use bytes::Bytes;
use jiff::Timestamp;
use uuid::Uuid;

use super::{Chosen, Rejection, ServiceError, ServiceMetrics};
use whereabouts_api::{ErrorKind, NoJob, NoJobReason};
use whereabouts_core::{
    Candidate, DenseFeatures, Descriptor, Digest, Job, Map, MediaType, Priority,
};
use whereabouts_refine::{DenseCache, DenseKey, JobServiceTime, JobSettings, Refiner};
use whereabouts_store::{BlobStore, JobRecord, JobStore, Query, StoreError};
use whereabouts_telemetry::traces;
use whereabouts_vision::Admission;

fn queue_full(limit: usize) -> NoJob {
    let full = StoreError::QueueFull { limit };
    NoJob::new(NoJobReason::QueueFull, format!("{full}; post a later frame for a refinement"))
}

/// A frame that was localized, with what a job needs of it.
pub(super) struct LocalizedFrame {
    pub query_id: Uuid,
    pub bytes: Bytes,
    /// The identity of the model that its descriptor is of.
    pub model: Digest,
    /// SHA-256 of the bytes.
    pub digest: Digest,
    pub media_type: MediaType,
    pub descriptor: Descriptor,
    pub dense: Option<DenseFeatures>,
    /// Why the frame cannot show a known place, if it cannot.
    pub uninformative: Option<String>,
}

/// How a job is to be refined.
pub(super) struct JobWish {
    /// The refiner.
    pub chosen: Chosen,
    pub priority: Priority,
}

/// Whether a frame got a refinement job.
#[derive(Debug)]
pub(super) enum Submission {
    /// The queued job; that of an earlier attempt, if the request was sent again.
    Queued(Box<Job>),
    /// The frame got no job, for this reason.
    Declined(NoJob),
}

/// Queues jobs for frames, and sheds them under load. Clones share the queue.
#[derive(Clone)]
pub struct Submitter {
    /// The job queue.
    pub jobs: Arc<dyn JobStore>,
    /// The bytes of frames.
    pub blobs: Arc<dyn BlobStore>,
    /// The cache of dense features, which the job will need soon.
    pub dense: Arc<DenseCache>,
    /// The refiner, if one is configured.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// Admission of images, whose queue length is the measure of load.
    pub admission: Arc<Admission>,
    /// The average time of a job, for `Retry-After`.
    pub service_time: JobServiceTime,
    /// Counts jobs and rejections.
    pub metrics: Arc<ServiceMetrics>,
    /// When frames get no job.
    pub settings: JobSettings,
}

impl Submitter {
    /// Rejects a caller that waits for the refined answer, if its frame would get no job now.
    pub(super) async fn check_capacity(&self) -> Result<(), ServiceError> {
        if self.refiner.is_none() {
            return Ok(());
        }
        self.reason_to_shed().await?.map_or(Ok(()), |why| Err(self.rejection(&why)))
    }

    /// Queues the refinement of a frame, or declines it. `request` is the id of a request with an idempotency key:
    /// an attempt to process it again gets the job that the first attempt queued.
    pub(super) async fn submit(
        &self,
        map: &Map,
        frame: LocalizedFrame,
        candidates: Vec<Candidate>,
        wish: JobWish,
        request: Option<&str>,
    ) -> Result<Submission, ServiceError> {
        let JobWish { chosen, priority } = wish;
        let kind = match chosen {
            Chosen::Refiner(kind) => kind,
            Chosen::None(why) => return Ok(Submission::Declined(why)),
        };
        let Some(refiner) = &self.refiner else {
            let detail = "the server has no refiner (refine.refiner)";
            return Ok(Submission::Declined(NoJob::new(NoJobReason::NoRefiner, detail)));
        };
        if candidates.is_empty() {
            let detail = "the map has no images yet; add some with `whereabouts index`";
            return Ok(Submission::Declined(NoJob::new(NoJobReason::EmptyMap, detail)));
        }
        if let Some(why) = self.reason_to_shed().await? {
            return Ok(Submission::Declined(why));
        }
        let query = Query {
            id: frame.query_id,
            digest: frame.digest,
            media_type: frame.media_type,
            created_at: Timestamp::now(),
            descriptor: refiner.wants_descriptor().then_some(frame.descriptor),
            uninformative: frame.uninformative,
        };
        let key = DenseKey { model: frame.model, picture: query.digest };
        if let Some(dense) = frame.dense {
            self.dense.insert(key, Arc::new(dense));
        }
        let trace = traces::current();
        let job = Job {
            priority,
            trace_id: trace.as_ref().map(|(_, id)| id.clone()),
            ..Job::queued(map.name.clone(), query.id, kind, query.created_at)
        };
        let record = JobRecord {
            traceparent: trace.map(|(traceparent, _)| traceparent),
            job: job.clone(),
            map_uid: map.uid,
            revision: map.revision,
            query,
            candidates,
            claims: 0,
        };
        let _pin = match self.blobs.put_blob(record.query.digest, frame.bytes).await {
            Ok(pin) => pin,
            Err(full @ StoreError::Full { .. }) => {
                let why = NoJob::new(NoJobReason::DiskFull, full.to_string());
                return Ok(Submission::Declined(self.counted(why)));
            }
            Err(error) => return Err(error.into()),
        };
        let limit = self.settings.queue;
        let submitted = match request {
            Some(request) => self.jobs.submit_once(record, limit, request).await,
            None => self.jobs.submit(record, limit).await.map(|()| None),
        };
        match submitted {
            // Queued by an attempt whose process ended before it could respond.
            Ok(Some(earlier)) => return Ok(Submission::Queued(Box::new(earlier))),
            Ok(None) => self.metrics.job_submitted(),
            Err(StoreError::QueueFull { limit }) => {
                return Ok(Submission::Declined(self.counted(queue_full(limit))));
            }
            Err(error) => return Err(error.into()),
        }
        Ok(Submission::Queued(Box::new(job)))
    }

    /// Returns why no job should be queued now; `None` if one may.
    async fn reason_to_shed(&self) -> Result<Option<NoJob>, ServiceError> {
        if self.jobs.queued().await? >= self.settings.queue {
            return Ok(Some(self.counted(queue_full(self.settings.queue))));
        }
        if self.admission.pressure() <= self.settings.shed_at {
            return Ok(None);
        }
        let detail = "the queue of pictures is too long for frames to get jobs (jobs.shed_at); post a later \
                      frame for a refinement";
        Ok(Some(self.counted(NoJob::new(NoJobReason::Overload, detail))))
    }

    fn counted(&self, why: NoJob) -> NoJob {
        self.metrics.refusals.count(Rejection::Jobs);
        why
    }

    /// The error for a caller that waits for the refined answer of a frame without a job.
    pub(super) fn rejection(&self, why: &NoJob) -> ServiceError {
        let pause = match why.reason {
            NoJobReason::QueueFull => {
                let service_time = self.service_time.lock();
                self.admission.clamp_pause(service_time.until_done(1))
            }
            _ => self.admission.retry_after(),
        };
        let detail = format!("{}, or ask with refine=async or refine=off", why.detail);
        ServiceError::new(ErrorKind::Overloaded, detail).retry_after(pause)
    }
}
