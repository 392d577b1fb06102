//! Localizes a frame: extracts its descriptor, searches the map, follows its track and queues its refinement.

use std::time::{Duration, Instant};

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use tracing::Instrument;
use uuid::Uuid;

use super::images::empty_body;
use super::submit::{JobWish, LocalizedFrame, Submission};
use super::{
    AllowedRefiners, Chosen, FrameEvidence, Jobs, Maps, RecallCheck, SUPERSEDED_RETRIES,
    ServiceError, Submitter, TrackStep, Tracks,
};
use whereabouts_api::{Answer, JobLink, RefineMode, TimingMs};
use whereabouts_core::confidence::COMPARED;
use whereabouts_core::{
    Calibration, Candidate, Digest, Estimate, Map, MapName, Priority, RefinerKind,
};
use whereabouts_index::SearchMode;
use whereabouts_store::StoreError;
use whereabouts_telemetry::traces;
use whereabouts_vision::{AdmissionRequest, Extraction, FeatureSet, WorkClass};

/// A frame to localize.
#[derive(Debug)]
pub struct LocalizeRequest {
    /// The map to search.
    pub map: MapName,
    /// Number of candidates in the answer; the configured number by default.
    pub k: Option<usize>,
    /// Whether the candidates are refined, and whether the caller waits for it.
    pub refine: RefineMode,
    /// The refiner of the job; by default that of the map or of the server.
    pub refiner: Option<RefinerKind>,
    /// The priority of the refinement job.
    pub priority: Priority,
    /// The bytes of the frame, in any format of [`MediaType`](whereabouts_core::MediaType).
    pub frame: Bytes,
    /// Time after which the caller no longer wants the answer.
    pub deadline: Option<Instant>,
    /// The track that the frame belongs to, if any.
    pub track: Option<TrackStep>,
    /// The id of a request with an idempotency key ([`Idempotency`](super::Idempotency)).
    pub idempotency_id: Option<String>,
}

/// The result of coarse retrieval for a frame.
#[derive(Debug)]
pub struct Retrieved {
    /// The map as it was searched.
    pub map: Map,
    /// The identity of the model.
    pub model: Digest,
    /// The most similar images, best first.
    pub candidates: Vec<Candidate>,
    /// The descriptor and dense features of the frame.
    pub extraction: Extraction,
    /// Duration of the search.
    pub searched: Duration,
}

/// Maximum of `localize.max_k`.
const MAX_CANDIDATES: usize = 100;

/// `[localize]`
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocalizeSettings {
    /// Default number of candidates in an answer.
    pub k: usize,
    /// Maximum number of candidates in an answer.
    pub max_k: usize,
    /// Minimum confidence of a known place.
    pub known_confidence: f64,
}

impl LocalizeSettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        if self.k == 0 {
            return Some("localize.k must be at least 1".into());
        }
        (self.max_k > MAX_CANDIDATES || self.k > self.max_k)
            .then(|| format!("localize.k <= localize.max_k <= {MAX_CANDIDATES} must hold"))
    }

    /// The number of candidates in an answer, if `k` was asked for.
    pub(super) fn checked_k(&self, k: Option<usize>) -> Result<usize, ServiceError> {
        let (k, most) = (k.unwrap_or(self.k), self.max_k);
        if (1..=most).contains(&k) {
            return Ok(k);
        }
        Err(ServiceError::unprocessable(format!("k is {k}; it must be between 1 and {most}")))
    }
}

/// Localizes frames: coarse retrieval, tracks, and the jobs that refine the answers.
pub struct Localizer {
    /// The maps.
    pub maps: Maps,
    /// The tracks of robots.
    pub tracks: Tracks,
    /// Queues refinement jobs.
    pub submitter: Submitter,
    /// Waits for refinement jobs.
    pub jobs: Jobs,
    /// Compares a sample of the searches with exact search.
    pub recall: RecallCheck,
    /// Bounds and defaults.
    pub settings: LocalizeSettings,
    /// The refiners that maps and requests may choose.
    pub refiners: AllowedRefiners,
}

impl Localizer {
    /// Answers with the most similar images and queues their refinement.
    pub async fn localize(&self, request: LocalizeRequest) -> Result<Answer, ServiceError> {
        let start = Instant::now();
        let k = self.settings.checked_k(request.k)?;
        if request.frame.is_empty() {
            return Err(empty_body());
        }
        if let Some(asked) = request.refiner {
            if request.refine == RefineMode::Off {
                return Err(ServiceError::malformed(
                    "refiner contradicts refine=off; leave one of them out",
                ));
            }
            self.refiners.check(asked)?;
        }
        let is_refined = request.refine != RefineMode::Off && self.submitter.refiner.is_some();
        if request.refine == RefineMode::Wait {
            // Rejected before any work is done.
            self.submitter.check_capacity().await?;
        }
        let admission = AdmissionRequest { class: WorkClass::Localize, deadline: request.deadline };
        let compared = if is_refined { self.refiners.most_candidates() } else { 0 };
        let tracked = request.track.as_ref().map_or(0, |_| self.tracks.candidates());
        let retrieved = k.max(compared).max(COMPARED).max(tracked);
        let features =
            if is_refined { FeatureSet::DescriptorAndDense } else { FeatureSet::DescriptorOnly };
        let search = (retrieved, SearchMode::Fast);
        let Retrieved { map, model, extraction, mut candidates, searched } =
            self.retrieve(&request.map, &request.frame, search, features, admission).await?;

        let calibration = self.maps.store.calibration(&map).await?.unwrap_or_default();
        let lack = extraction.information.lack();
        if let Some(why) = lack {
            self.maps.imaging.metrics.uninformative_frame(why);
        }
        let uninformative = lack.map(|why| why.to_string());
        let mut warnings = extraction.warnings;
        let track = match request.track {
            Some(step) => {
                // A frame that shows nothing moves the belief, but is no evidence.
                let evidence =
                    lack.is_none().then(|| FrameEvidence::new(&candidates, &calibration));
                let key = step.key(&map);
                let following = self.tracks.follow(&map, step, &extraction.descriptor, evidence);
                let (track, warning) = following.instrument(traces::stage("track")).await?;
                warnings.extend(warning);
                Some((key, track))
            }
            None => None,
        };
        let query_id = Uuid::now_v7();
        let chosen = match request.refine {
            RefineMode::Off => None,
            _ => Some(self.refiners.choose(&map, request.refiner)?),
        };
        let (mut job, no_job) = if let Some(chosen) = chosen {
            let compared = match &chosen {
                Chosen::Refiner(kind) => self.refiners.candidates(*kind),
                Chosen::None(_) => 0,
            };
            let compared = candidates.iter().take(compared).cloned().collect();
            let frame = LocalizedFrame {
                query_id,
                bytes: request.frame,
                model,
                digest: extraction.digest,
                media_type: extraction.media_type,
                descriptor: extraction.descriptor,
                dense: extraction.dense,
                uninformative: uninformative.clone(),
            };
            let id = request.idempotency_id.as_deref();
            let wish = JobWish { chosen, priority: request.priority };
            let submit = self.submitter.submit(&map, frame, compared, wish, id);
            match submit.instrument(traces::stage("submit")).await? {
                Submission::Queued(job) => {
                    if let Some((key, track)) = track.as_ref().filter(|(_, track)| !track.is_late) {
                        self.tracks.await_verdict(job.id, key.clone(), track.frames);
                    }
                    (Some(*job), None)
                }
                Submission::Declined(why)
                    if request.refine == RefineMode::Wait && why.is_shedding() =>
                {
                    return Err(self.submitter.rejection(&why));
                }
                Submission::Declined(why) => (None, Some(why)),
            }
        } else {
            (None, None)
        };
        let estimate = self.estimate(&candidates, &calibration);
        let mut estimate = estimate.map(|estimate| estimate.unless(uninformative.as_deref()));
        candidates.truncate(k);
        let mut ranking = None;
        if request.refine == RefineMode::Wait
            && let Some(queued) = &mut job
        {
            let longest = time_left(self.jobs.max_wait, request.deadline);
            *queued = self.jobs.wait_for(queued.id, longest).await?;
            estimate = queued.estimate.clone().or(estimate);
            ranking = queued.ranking.clone();
        }
        let ms = |duration: Duration| duration.as_secs_f64() * 1e3;
        Ok(Answer {
            query_id,
            map: map.name,
            model: map.model,
            candidates,
            estimate,
            track: track.map(|(_, track)| track),
            job: job.map(|job| JobLink {
                id: job.id,
                href: format!("/jobs/{}", job.id),
                state: job.state,
            }),
            ranking,
            no_job,
            warnings,
            timing_ms: TimingMs {
                decode: ms(extraction.times.decode),
                extract: ms(extraction.times.extract),
                search: ms(searched),
                total: ms(start.elapsed()),
            },
        })
    }

    /// Coarse retrieval: the `k` images of a map that are most similar to a frame, by the model that made the
    /// descriptors of the map.
    pub async fn retrieve(
        &self,
        map: &MapName,
        frame: &Bytes,
        (k, mode): (usize, SearchMode),
        features: FeatureSet,
        admission: AdmissionRequest,
    ) -> Result<Retrieved, ServiceError> {
        let mut retries = SUPERSEDED_RETRIES;
        loop {
            let (map, extractor, spec) = self.maps.usable(map).await?;
            let frame = frame.clone();
            let extracting =
                self.maps.imaging.extract(&extractor, frame, spec, features, admission);
            let extraction = extracting.instrument(traces::stage("extract")).await?;
            self.maps.imaging.metrics.observe_extraction(&extraction);
            let searching = Instant::now();
            let search = self.maps.store.search(&map, extraction.descriptor.clone(), k, mode);
            match search.instrument(traces::stage("search")).await {
                // A reindex ended meanwhile: the frame's descriptor is of the model before it.
                Err(StoreError::Superseded(_)) if retries > 0 => retries -= 1,
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

    /// The estimate by coarse retrieval alone: the first candidate with its confidence.
    fn estimate(&self, candidates: &[Candidate], calibration: &Calibration) -> Option<Estimate> {
        let first = candidates.first()?;
        let confidence = calibration.refined_confidence(candidates, &first.image_id, None);
        let min_known = self.settings.known_confidence;
        Some(Estimate::new(&first.image_id, first.pose, confidence, min_known))
    }
}

/// The time that a caller's deadline leaves for waiting, at most `longest`.
fn time_left(longest: Duration, deadline: Option<Instant>) -> Duration {
    deadline.map_or(longest, |deadline| {
        let left = deadline.saturating_duration_since(Instant::now());
        // A tenth is kept to build and send the answer.
        longest.min(left * 9 / 10)
    })
}
