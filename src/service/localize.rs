//! Localize a frame: extract, search, answer, and queue its refinement.

use std::time::{Duration, Instant};

use bytes::Bytes;
use tracing::Instrument;
use uuid::Uuid;

use super::images::empty_body;
use super::submit::Frame;
use super::{SUPERSEDED, Service, ServiceError, TrackStep};
use whereabouts_api::{Answer, JobLink, RefineMode, TimingMs};
use whereabouts_core::confidence::COMPARED;
use whereabouts_core::{Calibration, Candidate, Digest, Estimate, Map, MapName, Priority};
use whereabouts_index::SearchMode;
use whereabouts_store::StoreError;
use whereabouts_telemetry::traces;
use whereabouts_vision::{AdmissionRequest, Extraction, FeatureSet, WorkClass};

/// When a caller no longer wants the answer, if it said so.
#[derive(Debug, Clone, Copy, Default)]
pub struct Deadline(pub Option<Instant>);

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
    /// When the caller no longer wants the answer.
    pub deadline: Option<Instant>,
    /// Which track the frame belongs to, if any.
    pub track: Option<TrackStep>,
    /// The id of the request, if it is done once however often it comes ([`Service::begin_once`]).
    pub once: Option<String>,
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
        if request.refine == RefineMode::Wait {
            // Before any work is done.
            self.check_submission().await?;
        }
        let demand = AdmissionRequest { class: WorkClass::Localize, deadline: request.deadline };
        let compared = if refined { self.settings.candidates } else { 0 };
        let followed = request.track.as_ref().map_or(0, |_| self.tracks.candidates());
        let wanted = k.max(compared).max(COMPARED).max(followed);
        let features =
            if refined { FeatureSet::DescriptorAndDense } else { FeatureSet::DescriptorOnly };
        let search = (wanted, SearchMode::Fast);
        let Retrieved { map, model, extraction, mut candidates, searched } =
            self.retrieve(&request.map, &request.frame, search, features, demand).await?;

        let calibration = self.maps.calibration(&map).await?.unwrap_or_default();
        let track = match request.track {
            Some(step) => Some(self.follow(&map, step, &candidates, &calibration).await?),
            None => None,
        };
        let query_id = Uuid::now_v7();
        let (mut job, no_job) = if request.refine == RefineMode::Off {
            (None, None)
        } else {
            let compared = candidates.iter().take(self.settings.candidates).cloned().collect();
            let frame = Frame {
                query_id,
                bytes: request.frame,
                model,
                digest: extraction.digest,
                media_type: extraction.media_type,
                descriptor: extraction.descriptor,
                dense: extraction.dense,
            };
            let once = request.once.as_deref();
            let submit = self.submit(&map, frame, compared, request.priority, once);
            match submit.instrument(traces::stage("submit")).await? {
                Ok(job) => (Some(job), None),
                Err(why) if request.refine == RefineMode::Wait && why.is_shedding() => {
                    return Err(self.refuse_job(&why));
                }
                Err(why) => (None, Some(why)),
            }
        };
        let mut estimate = self.estimate(&candidates, &calibration);
        candidates.truncate(k);
        if request.refine == RefineMode::Wait
            && let Some(queued) = &mut job
        {
            let longest = Self::time_left(self.settings.max_wait, request.deadline);
            *queued = self.wait_for(queued.id, longest).await?;
            estimate = queued.estimate.clone().or(estimate);
        }
        let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
        Ok(Answer {
            query_id,
            map: map.name,
            model: map.model,
            candidates,
            estimate,
            track,
            job: job.map(|job| JobLink {
                id: job.id,
                href: format!("/jobs/{}", job.id),
                state: job.state,
            }),
            no_job,
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
        (k, mode): (usize, SearchMode),
        features: FeatureSet,
        demand: AdmissionRequest,
    ) -> Result<Retrieved, ServiceError> {
        let mut left = SUPERSEDED;
        loop {
            let (map, extractor) = self.usable_map(map).await?;
            let (frame, kind) = (frame.clone(), map.descriptor);
            let extracting = self.extract(&extractor, frame, kind, features, demand);
            let extraction = extracting.instrument(traces::stage("extract")).await?;
            self.metrics.observe_extraction(&extraction);
            let searching = Instant::now();
            let search = self.maps.search(&map, extraction.descriptor.clone(), k, mode);
            match search.instrument(traces::stage("search")).await {
                // The frame's descriptor is of the model that the map had a moment ago.
                Err(StoreError::Superseded(_)) if left > 0 => left -= 1,
                found => {
                    let (candidates, searched) = (found?, searching.elapsed());
                    self.metrics.observe_search(searched);
                    if mode == SearchMode::Fast {
                        self.check_search(&map, &extraction.descriptor, &candidates);
                    }
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
    fn estimate(&self, candidates: &[Candidate], calibration: &Calibration) -> Option<Estimate> {
        let first = candidates.first()?;
        let confidence = calibration.refined_confidence(candidates, &first.image_id, None);
        let known_from = self.settings.known_confidence;
        Some(Estimate::new(&first.image_id, first.pose, confidence, known_from))
    }
}
