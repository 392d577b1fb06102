//! The job of a frame, or why it has none: jobs are given up before frames are refused.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use jiff::Timestamp;
use uuid::Uuid;

use super::{Service, ServiceError};
use crate::Rejection;
use whereabouts_api::{ErrorKind, NoJob, NoJobReason};
use whereabouts_core::{
    Candidate, DenseFeatures, Descriptor, Digest, Job, Map, MediaType, Priority,
};
use whereabouts_refine::DenseKey;
use whereabouts_store::{JobRecord, Query, StoreError};
use whereabouts_telemetry::traces;

fn queue_full(limit: usize) -> NoJob {
    let full = StoreError::QueueFull { limit };
    NoJob::new(NoJobReason::QueueFull, format!("{full}; post a later frame for a refinement"))
}

/// A frame that has been localized.
pub(super) struct Frame {
    pub query_id: Uuid,
    pub bytes: Bytes,
    /// The identity of the model that looked at it.
    pub model: Digest,
    /// SHA-256 of the bytes.
    pub digest: Digest,
    pub media_type: MediaType,
    pub descriptor: Descriptor,
    pub dense: Option<DenseFeatures>,
}

impl Service {
    /// Refuses a caller who wants nothing but the refined answer, while frames get no job.
    pub(super) async fn check_submission(&self) -> Result<(), ServiceError> {
        if self.refiner.is_none() {
            return Ok(());
        }
        self.obstacle().await?.map_or(Ok(()), |why| Err(self.refuse_job(&why)))
    }

    /// Queues the refinement of a frame, unless something speaks against it.
    pub(super) async fn submit(
        &self,
        map: &Map,
        frame: Frame,
        candidates: Vec<Candidate>,
        priority: Priority,
        once: Option<&str>,
    ) -> Result<Result<Job, NoJob>, ServiceError> {
        let Some(refiner) = &self.refiner else {
            let detail = "the server refines nothing (refine.refiner)";
            return Ok(Err(NoJob::new(NoJobReason::NoRefiner, detail)));
        };
        if candidates.is_empty() {
            let detail = "the map has no images yet; add some with `whereabouts index`";
            return Ok(Err(NoJob::new(NoJobReason::EmptyMap, detail)));
        }
        if let Some(why) = self.obstacle().await? {
            return Ok(Err(why));
        }
        let query = Query {
            id: frame.query_id,
            digest: frame.digest,
            media_type: frame.media_type,
            created_at: Timestamp::now(),
            descriptor: refiner.wants_descriptor().then_some(frame.descriptor),
        };
        let key = DenseKey { model: frame.model, picture: query.digest };
        if let Some(dense) = frame.dense {
            self.dense.insert(key, Arc::new(dense));
        }
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
                return Ok(Err(self.counted_job(why)));
            }
            Err(error) => return Err(error.into()),
        };
        let limit = self.settings.job_queue;
        let submitted = match once {
            Some(request) => self.jobs.submit_once(record, limit, request).await,
            None => self.jobs.submit(record, limit).await.map(|()| None),
        };
        match submitted {
            // A process that ended before it could answer has queued it.
            Ok(Some(before)) => return Ok(Ok(before)),
            Ok(None) => self.metrics.job_submitted(),
            Err(StoreError::QueueFull { limit }) => {
                return Ok(Err(self.counted_job(queue_full(limit))));
            }
            Err(error) => return Err(error.into()),
        }
        Ok(Ok(job))
    }

    /// Why no job should be submitted now, if so.
    async fn obstacle(&self) -> Result<Option<NoJob>, ServiceError> {
        if self.jobs.queued().await? >= self.settings.job_queue {
            return Ok(Some(self.counted_job(queue_full(self.settings.job_queue))));
        }
        if self.admission.pressure() <= self.settings.shed_jobs_at {
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
    pub(super) fn refuse_job(&self, why: &NoJob) -> ServiceError {
        let pause = match why.reason {
            NoJobReason::QueueFull => {
                let pace = self.job_pace.lock();
                self.admission.clamp_pause(pace.until_done(1))
            }
            _ => self.admission.retry_after(),
        };
        let detail = format!("{}, or ask with refine=async or refine=off", why.detail);
        ServiceError::new(ErrorKind::Overloaded, detail).retry_after(pause)
    }

    /// The time that a caller's deadline leaves for waiting, no longer than `longest`.
    pub(super) fn time_left(longest: Duration, deadline: Option<Instant>) -> Duration {
        deadline.map_or(longest, |deadline| {
            let left = deadline.saturating_duration_since(Instant::now());
            // The answer has still to be made and sent.
            longest.min(left * 9 / 10)
        })
    }
}
