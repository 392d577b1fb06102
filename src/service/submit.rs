//! The job of a frame, or why it has none: jobs are given up before frames are refused.

use std::sync::Arc;

use bytes::Bytes;
use jiff::Timestamp;
use uuid::Uuid;

use super::{Rejection, ServiceError, ServiceMetrics};
use whereabouts_api::{ErrorKind, NoJob, NoJobReason};
use whereabouts_core::{
    Candidate, DenseFeatures, Descriptor, Digest, Job, Map, MediaType, Priority,
};
use whereabouts_refine::{DenseCache, DenseKey, JobServiceTime, Refiner};
use whereabouts_store::{BlobStore, JobRecord, JobStore, Query, StoreError};
use whereabouts_telemetry::traces;
use whereabouts_vision::Admission;

fn queue_full(limit: usize) -> NoJob {
    let full = StoreError::QueueFull { limit };
    NoJob::new(NoJobReason::QueueFull, format!("{full}; post a later frame for a refinement"))
}

/// A frame that has been localized.
pub(super) struct LocalizedFrame {
    pub query_id: Uuid,
    pub bytes: Bytes,
    /// The identity of the model that looked at it.
    pub model: Digest,
    pub media_type: MediaType,
    pub descriptor: Descriptor,
    pub dense: DenseFeatures,
}

/// Whether a frame got a job.
#[derive(Debug)]
pub(super) enum Submission {
    /// A job is queued; the one of an earlier attempt, if the request was sent again.
    Queued(Job),
    /// There is none, and why.
    Declined(NoJob),
}

/// Queues jobs for frames, and sheds them under load. Clones share the queue.
#[derive(Clone)]
pub struct Submitter {
    /// The job queue.
    pub jobs: Arc<dyn JobStore>,
    /// The bytes of frames.
    pub blobs: Arc<dyn BlobStore>,
    /// Dense features that the job will need soon.
    pub dense: Arc<DenseCache>,
    /// What refines jobs, if anything does.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// The queue of images before decoding, whose length is the measure of load.
    pub admission: Arc<Admission>,
    /// How long a job takes, for `Retry-After`.
    pub service_time: JobServiceTime,
    /// Counts jobs and rejections.
    pub metrics: Arc<ServiceMetrics>,
    /// The most jobs that wait or run.
    pub queue: usize,
    /// The share of the image queue from which on frames get no job.
    pub shed_at: f64,
}

impl Submitter {
    /// Refuses a caller who wants nothing but the refined answer, while frames get no job.
    pub(super) async fn check(&self) -> Result<(), ServiceError> {
        if self.refiner.is_none() {
            return Ok(());
        }
        self.obstacle().await?.map_or(Ok(()), |why| Err(self.refuse(&why)))
    }

    /// Queues the refinement of a frame, unless something speaks against it.
    pub(super) async fn submit(
        &self,
        map: &Map,
        frame: LocalizedFrame,
        candidates: Vec<Candidate>,
        priority: Priority,
        once: Option<&str>,
    ) -> Result<Submission, ServiceError> {
        let Some(refiner) = &self.refiner else {
            let detail = "the server refines nothing (refine.refiner)";
            return Ok(Submission::Declined(NoJob::new(NoJobReason::NoRefiner, detail)));
        };
        if candidates.is_empty() {
            let detail = "the map has no images yet; add some with `whereabouts index`";
            return Ok(Submission::Declined(NoJob::new(NoJobReason::EmptyMap, detail)));
        }
        if let Some(why) = self.obstacle().await? {
            return Ok(Submission::Declined(why));
        }
        let query = Query {
            id: frame.query_id,
            digest: Digest::of(&frame.bytes),
            media_type: frame.media_type,
            created_at: Timestamp::now(),
            descriptor: refiner.wants_descriptor().then_some(frame.descriptor),
        };
        let key = DenseKey { model: frame.model, picture: query.digest };
        self.dense.insert(key, Arc::new(frame.dense));
        let trace = traces::current();
        let job = Job {
            priority,
            trace_id: trace.as_ref().map(|(_, id)| id.clone()),
            ..Job::queued(map.name.clone(), query.id, refiner.kind(), query.created_at)
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
                return Ok(Submission::Declined(self.counted_job(why)));
            }
            Err(error) => return Err(error.into()),
        };
        let limit = self.queue;
        let submitted = match once {
            Some(request) => self.jobs.submit_once(record, limit, request).await,
            None => self.jobs.submit(record, limit).await.map(|()| None),
        };
        match submitted {
            // A process that ended before it could answer has queued it.
            Ok(Some(before)) => return Ok(Submission::Queued(before)),
            Ok(None) => self.metrics.job_submitted(),
            Err(StoreError::QueueFull { limit }) => {
                return Ok(Submission::Declined(self.counted_job(queue_full(limit))));
            }
            Err(error) => return Err(error.into()),
        }
        Ok(Submission::Queued(job))
    }

    /// Why no job should be submitted now, if so.
    async fn obstacle(&self) -> Result<Option<NoJob>, ServiceError> {
        if self.jobs.queued().await? >= self.queue {
            return Ok(Some(self.counted_job(queue_full(self.queue))));
        }
        if self.admission.pressure() <= self.shed_at {
            return Ok(None);
        }
        let detail = "so many pictures wait that no frame gets a job (jobs.shed_at); post a later \
                      frame for a refinement";
        Ok(Some(self.counted_job(NoJob::new(NoJobReason::Overload, detail))))
    }

    fn counted_job(&self, why: NoJob) -> NoJob {
        self.metrics.refusals.count(Rejection::Jobs);
        why
    }

    /// What a caller hears who wants nothing but the refined answer.
    pub(super) fn refuse(&self, why: &NoJob) -> ServiceError {
        let pause = match why.reason {
            NoJobReason::QueueFull => {
                let pace = self.service_time.lock();
                self.admission.within_bounds(pace.until_done(1))
            }
            _ => self.admission.retry_after(),
        };
        let detail = format!("{}, or ask with refine=async or refine=off", why.detail);
        ServiceError::new(ErrorKind::Overloaded, detail).retry_after(pause)
    }
}
