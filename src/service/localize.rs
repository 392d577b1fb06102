//! Localize a frame: extract, search, answer, and queue its refinement.

use std::time::{Duration, Instant};

use bytes::Bytes;
use tracing::Instrument;
use uuid::Uuid;

use super::images::empty_body;
use super::submit::{LocalizedFrame, Submission};
use super::{Jobs, Maps, RecallCheck, SUPERSEDED, ServiceError, Submitter, TrackStep, Tracks};
use whereabouts_api::{Answer, JobLink, RefineMode, TimingMs};
use whereabouts_core::confidence::COMPARED;
use whereabouts_core::{Calibration, Candidate, Digest, Estimate, Map, MapName, Priority};
use whereabouts_index::SearchMode;
use whereabouts_store::StoreError;
use whereabouts_telemetry::traces;
use whereabouts_vision::{AdmissionRequest, Extraction, WorkClass};

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
    /// The id of the request, if it is done once however often it comes ([`Idempotency`](super::Idempotency)).
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

/// Bounds and defaults of localization.
#[derive(Debug, Clone, Copy)]
pub struct LocalizeSettings {
    /// Candidates in an answer, unless the caller says otherwise.
    pub k: usize,
    /// The most candidates in an answer.
    pub max_k: usize,
    /// Candidates that a job compares.
    pub compared: usize,
    /// The confidence from which on a place counts as known.
    pub known_confidence: f64,
}

/// Localizes frames: coarse retrieval, the track that a frame belongs to, and the job that refines the answer.
pub struct Localizer {
    /// The maps.
    pub maps: Maps,
    /// The tracks of robots.
    pub tracks: Tracks,
    /// Queues the refinement.
    pub submitter: Submitter,
    /// Waits for the refinement.
    pub jobs: Jobs,
    /// Compares searches with exact ones now and then.
    pub recall: RecallCheck,
    /// Bounds and defaults.
    pub settings: LocalizeSettings,
}

impl Localizer {
    /// Answers with the most similar images and queues their refinement.
    pub async fn localize(&self, request: LocalizeRequest) -> Result<Answer, ServiceError> {
        let start = Instant::now();
        let k = self.checked_k(request.k)?;
        if request.frame.is_empty() {
            return Err(empty_body());
        }
        let refined = request.refine != RefineMode::Off && self.submitter.refiner.is_some();
        if request.refine == RefineMode::Wait {
            // Before any work is done.
            self.submitter.check().await?;
        }
        let demand = AdmissionRequest { class: WorkClass::Localize, deadline: request.deadline };
        let compared = if refined { self.settings.compared } else { 0 };
        let followed = request.track.as_ref().map_or(0, |_| self.tracks.candidates());
        let wanted = k.max(compared).max(COMPARED).max(followed);
        let Retrieved { map, model, extraction, mut candidates, searched } =
            self.retrieve(&request.map, &request.frame, wanted, SearchMode::Fast, demand).await?;

        let calibration = self.maps.store.calibration(&map).await?.unwrap_or_default();
        let track = match request.track {
            Some(step) => Some(self.tracks.follow(&map, step, &candidates, &calibration).await?),
            None => None,
        };
        let query_id = Uuid::now_v7();
        let (mut job, no_job) = if request.refine == RefineMode::Off {
            (None, None)
        } else {
            let compared = candidates.iter().take(self.settings.compared).cloned().collect();
            let frame = LocalizedFrame {
                query_id,
                bytes: request.frame,
                model,
                media_type: extraction.media_type,
                descriptor: extraction.descriptor,
                dense: extraction.dense,
            };
            let once = request.once.as_deref();
            let submit = self.submitter.submit(&map, frame, compared, request.priority, once);
            match submit.instrument(traces::stage("submit")).await? {
                Submission::Queued(job) => (Some(job), None),
                Submission::Declined(why)
                    if request.refine == RefineMode::Wait && why.is_shedding() =>
                {
                    return Err(self.submitter.refuse(&why));
                }
                Submission::Declined(why) => (None, Some(why)),
            }
        };
        let mut estimate = self.estimate(&candidates, &calibration);
        candidates.truncate(k);
        if request.refine == RefineMode::Wait
            && let Some(queued) = &mut job
        {
            let longest = time_left(self.jobs.max_wait, request.deadline);
            *queued = self.jobs.wait_for(queued.id, longest).await?;
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
        k: usize,
        mode: SearchMode,
        demand: AdmissionRequest,
    ) -> Result<Retrieved, ServiceError> {
        let mut left = SUPERSEDED;
        loop {
            let (map, extractor) = self.maps.usable(map).await?;
            let extracting =
                self.maps.imaging.extract(&extractor, frame.clone(), map.descriptor, demand);
            let extraction = extracting.instrument(traces::stage("extract")).await?;
            self.maps.imaging.metrics.observe_extraction(&extraction);
            let searching = Instant::now();
            let search = self.maps.store.search(&map, extraction.descriptor.clone(), k, mode);
            match search.instrument(traces::stage("search")).await {
                // The frame's descriptor is of the model that the map had a moment ago.
                Err(StoreError::Superseded(_)) if left > 0 => left -= 1,
                found => {
                    let (candidates, searched) = (found?, searching.elapsed());
                    self.maps.imaging.metrics.observe_search(searched);
                    if mode == SearchMode::Fast {
                        self.recall.check(
                            &self.maps.store,
                            &self.maps.imaging.metrics,
                            &map,
                            &extraction.descriptor,
                            &candidates,
                        );
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

/// The time that a caller's deadline leaves for waiting, no longer than `longest`.
fn time_left(longest: Duration, deadline: Option<Instant>) -> Duration {
    deadline.map_or(longest, |deadline| {
        let left = deadline.saturating_duration_since(Instant::now());
        // The answer has still to be made and sent.
        longest.min(left * 9 / 10)
    })
}
