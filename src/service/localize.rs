//! Localize a frame: extract, search, answer, and queue its refinement.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use super::images::empty_body;
use super::{ErrorKind, SUPERSEDED, Service, ServiceError};
use crate::domain::confidence::COMPARED;
use crate::domain::{Candidate, Digest, Estimate, Job, JobState, Map, MapName, Priority};
use crate::refine::DenseKey;
use crate::retrieve::Extraction;
use crate::retrieve::index::SearchMode;
use crate::store::{JobRecord, Query, StoreError};

/// What becomes of the candidates after the first answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RefineMode {
    /// A job refines them; the answer does not wait.
    #[default]
    Async,
    /// A job refines them; the answer waits for it, and its estimate follows the refined order.
    Wait,
    /// Nothing.
    Off,
}

/// A frame to localize.
#[derive(Debug)]
pub struct LocalizeRequest {
    /// In which map.
    pub map: MapName,
    /// How many candidates to answer; by default the configured number.
    pub k: Option<usize>,
    /// What becomes of them.
    pub refine: RefineMode,
    /// How soon a job refines them.
    pub priority: Priority,
    /// The bytes of the frame: JPEG, PNG or WebP.
    pub frame: Bytes,
}

/// Where the frame was probably taken.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Answer {
    /// The id of this query.
    pub query_id: Uuid,
    /// The map.
    pub map: MapName,
    /// The model that made the descriptor.
    pub model: String,
    /// The most similar images, best first.
    pub candidates: Vec<Candidate>,
    /// The best guess; null in an empty map.
    #[schema(nullable)]
    pub estimate: Option<Estimate>,
    /// The refinement; null if there is none.
    #[schema(nullable)]
    pub job: Option<JobLink>,
    /// How long the stages took.
    pub timing_ms: TimingMs,
}

/// Where to find a job.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct JobLink {
    /// Its id.
    pub id: Uuid,
    /// Its address.
    pub href: String,
    /// How far it has come.
    pub state: JobState,
}

/// How long the stages of an answer took, in milliseconds.
#[derive(Debug, Clone, Copy, Serialize, Deserialize, ToSchema)]
pub struct TimingMs {
    /// Decoding and resizing.
    pub decode: f64,
    /// Inference and pooling, including the wait for a free session.
    pub extract: f64,
    /// Search.
    pub search: f64,
    /// Everything until the answer, including the wait for a free thread and for the disk.
    pub total: f64,
}

/// What the coarse retriever found for a frame.
#[derive(Debug)]
pub struct Retrieved {
    /// The map, as it was searched.
    pub map: Map,
    /// The identity of the model.
    pub model: Digest,
    /// The most similar images, best first.
    pub candidates: Vec<Candidate>,
    /// What was extracted from the frame.
    pub extraction: Extraction,
    /// How long the search took.
    pub searched: Duration,
}

impl Service {
    /// Answers with the most similar images and queues their refinement.
    pub async fn localize(&self, request: LocalizeRequest) -> Result<Answer, ServiceError> {
        let start = Instant::now();
        let k = self.checked_k(request.k)?;
        if request.frame.is_empty() {
            return Err(empty_body());
        }
        let refined = request.refine != RefineMode::Off && self.refiner.is_some();
        if refined && self.jobs.queued().await? >= self.settings.job_queue {
            // Before any work is done: a robot that needs no job asks without one.
            return Err(StoreError::QueueFull { limit: self.settings.job_queue }.into());
        }
        let compared = if refined { self.settings.candidates } else { 0 };
        let wanted = k.max(compared).max(COMPARED);
        let Retrieved { map, model, extraction, mut candidates, searched } =
            self.retrieve(&request.map, &request.frame, wanted, SearchMode::Fast).await?;
        let kept = self.refiner.as_ref().filter(|refiner| refiner.wants_descriptor());
        let descriptor = kept.map(|_| extraction.descriptor);

        let query_id = Uuid::now_v7();
        let mut job = None;
        if refined && !candidates.is_empty() {
            let query = Query {
                id: query_id,
                digest: Digest::of(&request.frame),
                media_type: extraction.media_type,
                created_at: Timestamp::now(),
                descriptor,
            };
            let key = DenseKey { model, picture: query.digest };
            self.dense.insert(key, Arc::new(extraction.dense));
            let compared = candidates.iter().take(self.settings.candidates).cloned().collect();
            job = Some(self.submit(&map, query, compared, request.frame, request.priority).await?);
        }
        let mut estimate = self.estimate(&map, &candidates).await?;
        candidates.truncate(k);
        if request.refine == RefineMode::Wait
            && let Some(queued) = &mut job
        {
            *queued = self.wait_for(queued.id, self.settings.max_wait).await?;
            estimate = queued.estimate.clone().or(estimate);
        }
        let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
        Ok(Answer {
            query_id,
            map: map.name,
            model: map.model,
            candidates,
            estimate,
            job: job.map(|job| JobLink {
                id: job.id,
                href: format!("/jobs/{}", job.id),
                state: job.state,
            }),
            timing_ms: TimingMs {
                decode: ms(extraction.times.decode),
                extract: ms(extraction.times.extract),
                search: ms(searched),
                total: ms(start.elapsed()),
            },
        })
    }

    /// The coarse retriever: the `k` images of a map that look most like a frame, by the model that
    /// the map's descriptors are of.
    pub async fn retrieve(
        &self,
        map: &MapName,
        frame: &Bytes,
        k: usize,
        mode: SearchMode,
    ) -> Result<Retrieved, ServiceError> {
        let mut left = SUPERSEDED;
        loop {
            let (map, extractor) = self.usable_map(map).await?;
            let extraction = self.extract(&extractor, frame.clone(), map.descriptor).await?;
            self.metrics.observe_stages(extraction.times);
            let searching = Instant::now();
            match self.maps.search(&map, extraction.descriptor.clone(), k, mode).await {
                // The frame's descriptor is of the model that the map had a moment ago.
                Err(StoreError::Superseded(_)) if left > 0 => left -= 1,
                found => {
                    let (candidates, searched) = (found?, searching.elapsed());
                    self.metrics.observe_search(searched);
                    let model = extractor.identity();
                    return Ok(Retrieved { map, model, extraction, candidates, searched });
                }
            }
        }
    }

    fn checked_k(&self, k: Option<usize>) -> Result<usize, ServiceError> {
        let k = k.unwrap_or(self.settings.k);
        if (1..=self.settings.max_k).contains(&k) {
            return Ok(k);
        }
        Err(ServiceError::unprocessable(format!(
            "k is {k}; it must be between 1 and {}",
            self.settings.max_k
        )))
    }

    /// The first candidate, and how sure it is.
    async fn estimate(
        &self,
        map: &Map,
        candidates: &[Candidate],
    ) -> Result<Option<Estimate>, ServiceError> {
        let Some(first) = candidates.first() else { return Ok(None) };
        let confidence = self.confidence(map, candidates, &first.image_id).await?;
        Ok(Some(Estimate {
            image_id: first.image_id.clone(),
            pose: first.pose,
            confidence,
            known: f64::from(confidence) >= self.settings.known_confidence,
        }))
    }

    async fn submit(
        &self,
        map: &Map,
        query: Query,
        candidates: Vec<Candidate>,
        frame: Bytes,
        priority: Priority,
    ) -> Result<Job, ServiceError> {
        let Some(refiner) = &self.refiner else {
            return Err(ServiceError::new(ErrorKind::Internal, "there is no refiner"));
        };
        let job = Job {
            priority,
            ..Job::queued(map.name.clone(), query.id, refiner.kind(), query.created_at)
        };
        let record = JobRecord {
            job: job.clone(),
            map_uid: map.uid,
            revision: map.revision,
            query,
            candidates,
            claims: 0,
        };
        let _pin = self.blobs.put_blob(record.query.digest, frame).await?;
        self.jobs.submit(record, self.settings.job_queue).await?;
        self.metrics.job_submitted();
        Ok(job)
    }
}
