//! Conversions from domain and wire types to gRPC messages.

use jiff::Timestamp;
use whereabouts_core::{
    Candidate, Certainty, CoordinateFrame, Description, Estimate, Image, Job, JobState, JobVerdict,
    Pose, Priority, RankedCandidate, RefinerKind, Scene, Usage,
};

use crate::{
    Answer, IndexKind, MapState, NoJob, NoJobReason, TimingMs, TrackEstimate, TrackHypothesis,
    VocabularyChoice, VocabularyState, proto,
};

/// Converts a job state to its gRPC message.
pub fn job_state_to(state: JobState) -> proto::JobState {
    match state {
        JobState::Queued => proto::JobState::Queued,
        JobState::Running => proto::JobState::Running,
        JobState::Succeeded => proto::JobState::Succeeded,
        JobState::Degraded => proto::JobState::Degraded,
        JobState::Failed => proto::JobState::Failed,
        JobState::Cancelled => proto::JobState::Cancelled,
    }
}

/// Converts a timestamp to its gRPC message.
pub fn moment_to(moment: Timestamp) -> prost_types::Timestamp {
    const NANOS_PER_SECOND: i128 = 1_000_000_000;
    let nanos = moment.as_nanosecond();
    prost_types::Timestamp {
        seconds: nanos.div_euclid(NANOS_PER_SECOND) as i64,
        nanos: nanos.rem_euclid(NANOS_PER_SECOND) as i32,
    }
}

impl From<Pose> for proto::Pose {
    fn from(pose: Pose) -> Self {
        let frame = match pose {
            Pose::Geographic(pose) => proto::pose::Frame::Geographic(proto::GeographicPose {
                lat: pose.lat,
                lon: pose.lon,
                alt: pose.alt,
                heading: pose.heading,
            }),
            Pose::Metric(pose) => proto::pose::Frame::Metric(proto::MetricPose {
                x: pose.x,
                y: pose.y,
                z: pose.z,
                orientation: (|| {
                    Some(proto::Quaternion { x: pose.qx?, y: pose.qy?, z: pose.qz?, w: pose.qw? })
                })(),
            }),
        };
        Self { frame: Some(frame) }
    }
}

impl From<Candidate> for proto::Candidate {
    fn from(candidate: Candidate) -> Self {
        Self {
            rank: candidate.rank as u32,
            image_id: candidate.image_id.into(),
            similarity: candidate.similarity,
            pose: candidate.pose.map(Into::into),
        }
    }
}

impl From<&RankedCandidate> for proto::RankedCandidate {
    fn from(candidate: &RankedCandidate) -> Self {
        Self {
            rank: candidate.rank as u32,
            image_id: candidate.image_id.to_string(),
            coarse_rank: candidate.coarse_rank as u32,
            pose: candidate.pose.map(Into::into),
        }
    }
}

impl From<Estimate> for proto::Estimate {
    fn from(estimate: Estimate) -> Self {
        Self {
            image_id: estimate.image_id.into(),
            pose: estimate.pose.map(Into::into),
            confidence: estimate.confidence,
            known: estimate.known,
            reason: estimate.reason.unwrap_or_default(),
        }
    }
}

impl From<Answer> for proto::LocalizeResponse {
    fn from(answer: Answer) -> Self {
        let ranking = answer.ranking.as_ref().map(|ranking| ranking.as_slice()).unwrap_or_default();
        Self {
            query_id: answer.query_id.to_string(),
            map: answer.map.into(),
            model: answer.model,
            candidates: answer.candidates.into_iter().map(Into::into).collect(),
            estimate: answer.estimate.map(Into::into),
            track: answer.track.map(Into::into),
            job: answer.job.map(|job| proto::JobLink {
                id: job.id.to_string(),
                state: job_state_to(job.state).into(),
            }),
            no_job: answer.no_job.map(Into::into),
            timing: Some(answer.timing_ms.into()),
            warnings: answer.warnings,
            ranking: ranking.iter().map(Into::into).collect(),
        }
    }
}

impl From<TrackEstimate> for proto::TrackEstimate {
    fn from(track: TrackEstimate) -> Self {
        Self {
            id: track.id,
            frames: track.frames,
            image_id: track.image_id.map(Into::into).unwrap_or_default(),
            pose: track.pose.map(Into::into),
            probability: track.probability,
            known: track.known,
            others: track.others.into_iter().map(Into::into).collect(),
            is_late: track.is_late,
            off_map: track.off_map,
        }
    }
}

impl From<TrackHypothesis> for proto::TrackHypothesis {
    fn from(hypothesis: TrackHypothesis) -> Self {
        Self {
            image_id: hypothesis.image_id.into(),
            pose: hypothesis.pose.map(Into::into),
            probability: hypothesis.probability,
        }
    }
}

impl From<NoJob> for proto::NoJob {
    fn from(no_job: NoJob) -> Self {
        let reason = match no_job.reason {
            NoJobReason::NoRefiner => proto::NoJobReason::NoRefiner,
            NoJobReason::EmptyMap => proto::NoJobReason::EmptyMap,
            NoJobReason::QueueFull => proto::NoJobReason::QueueFull,
            NoJobReason::Overload => proto::NoJobReason::Overload,
            NoJobReason::DiskFull => proto::NoJobReason::DiskFull,
        };
        Self { reason: reason.into(), detail: no_job.detail }
    }
}

impl From<TimingMs> for proto::Timing {
    fn from(timing: TimingMs) -> Self {
        Self {
            decode_ms: timing.decode,
            extract_ms: timing.extract,
            search_ms: timing.search,
            total_ms: timing.total,
        }
    }
}

impl From<Usage> for proto::Usage {
    fn from(usage: Usage) -> Self {
        Self {
            calls: usage.calls,
            cached: usage.cached,
            prompt_tokens: usage.prompt_tokens,
            completion_tokens: usage.completion_tokens,
            estimated: usage.estimated,
        }
    }
}

impl From<Description> for proto::Description {
    fn from(description: Description) -> Self {
        Self {
            image_id: description.image_id.into(),
            text: description.text,
            cached: description.cached,
            stands_in: description.stands_in.map(|earlier| proto::StandIn {
                query_id: earlier.query_id.to_string(),
                similarity: earlier.similarity,
            }),
            usage: Some(description.usage.into()),
            took_ms: description.took_ms,
        }
    }
}

/// Converts a refiner.
pub fn refiner_to(refiner: RefinerKind) -> proto::Refiner {
    match refiner {
        RefinerKind::Local => proto::Refiner::Local,
        RefinerKind::Cascade => proto::Refiner::Cascade,
        RefinerKind::Mllm => proto::Refiner::Mllm,
    }
}

impl From<JobVerdict> for proto::JobVerdict {
    fn from(verdict: JobVerdict) -> Self {
        let certainty = match verdict.certainty {
            None => proto::Certainty::Unspecified,
            Some(Certainty::Certain) => proto::Certainty::Certain,
            Some(Certainty::Likely) => proto::Certainty::Likely,
            Some(Certainty::Unsure) => proto::Certainty::Unsure,
            Some(Certainty::None) => proto::Certainty::NoneOfThese,
        };
        Self {
            refiner: refiner_to(verdict.refiner).into(),
            image_id: verdict.image_id.into(),
            confidence: verdict.confidence,
            certainty: certainty.into(),
            compared: verdict.compared as u32,
            then: verdict.then.unwrap_or_default(),
        }
    }
}

impl From<Job> for proto::Job {
    fn from(job: Job) -> Self {
        let priority = match job.priority {
            Priority::Low => proto::Priority::Low,
            Priority::Normal => proto::Priority::Normal,
            Priority::High => proto::Priority::High,
        };
        let ranking = job.ranking.as_ref().map(|ranking| ranking.as_slice()).unwrap_or_default();
        Self {
            id: job.id.to_string(),
            map: job.map.into(),
            query_id: job.query_id.to_string(),
            refiner: refiner_to(job.refiner).into(),
            priority: priority.into(),
            state: job_state_to(job.state).into(),
            created_at: Some(moment_to(job.created_at)),
            started_at: job.started_at.map(moment_to),
            finished_at: job.finished_at.map(moment_to),
            attempts: job.attempts,
            descriptions: job.descriptions.into_iter().map(Into::into).collect(),
            ranking: ranking.iter().map(Into::into).collect(),
            reasoning: job.reasoning.unwrap_or_default(),
            reasoning_took_ms: job.reasoning_took_ms,
            estimate: job.estimate.map(Into::into),
            usage: Some(job.usage.into()),
            error: job.error.unwrap_or_default(),
            trace_id: job.trace_id.unwrap_or_default(),
            fresh_since: job.fresh_since.map(moment_to),
            verdicts: job.verdicts.into_iter().map(Into::into).collect(),
            texts: job.texts.into_iter().flatten().map(Into::into).collect(),
        }
    }
}

impl From<Image> for proto::Image {
    fn from(image: Image) -> Self {
        Self {
            id: image.id.into(),
            digest: image.digest.to_string(),
            pose: image.pose.map(Into::into),
            captured_at: image.captured_at.map(moment_to),
            tags: image.tags,
            width: image.width,
            height: image.height,
            created_at: Some(moment_to(image.created_at)),
        }
    }
}

impl From<MapState> for proto::Map {
    fn from(map: MapState) -> Self {
        let scene = match map.scene {
            Scene::Indoor => proto::Scene::Indoor,
            Scene::Outdoor => proto::Scene::Outdoor,
        };
        let frame = match map.frame {
            CoordinateFrame::Wgs84 => proto::Frame::Wgs84,
            CoordinateFrame::Metric => proto::Frame::Metric,
        };
        let index = match map.index {
            IndexKind::Exact => proto::Index::Exact,
            IndexKind::Building => proto::Index::Building,
            IndexKind::Hnsw => proto::Index::Hnsw,
        };
        Self {
            name: map.name.into(),
            scene: scene.into(),
            descriptor: map.descriptor.to_string(),
            frame: frame.into(),
            model: map.model,
            model_digest: map.model_digest.to_string(),
            dim: map.dim as u32,
            images: map.images as u64,
            index: index.into(),
            description: map.description.unwrap_or_default(),
            created_at: Some(moment_to(map.created_at)),
            refiner: map.refiner.map_or(proto::Refiner::Unspecified, refiner_to).into(),
            vocabulary: map.vocabulary.map(vocabulary_to),
            texts: map.texts.map(Into::into),
        }
    }
}

fn vocabulary_to(vocabulary: VocabularyState) -> proto::MapVocabulary {
    proto::MapVocabulary {
        own: vocabulary.source == VocabularyChoice::Own,
        digest: vocabulary.digest.map_or_else(String::new, |digest| digest.to_string()),
        fitted_at: vocabulary.fitted_at.map(moment_to),
        images: vocabulary.images.unwrap_or_default() as u64,
        reason: vocabulary.reason.unwrap_or_default(),
    }
}
