//! Between the messages of the contract and the types of the service.

use jiff::Timestamp;
use serde_json::{Map as JsonObject, Value};

use super::proto;
use crate::domain::{
    Candidate, Description, DescriptorKind, Estimate, Frame, Job, JobState, Pose, Priority,
    RankedCandidate, RefinerKind, Scene, Usage,
};
use crate::service::{
    Answer, IndexKind, MapState, NoJob, NoJobReason, RefineMode, ServiceError, TimingMs,
    TrackEstimate,
};

/// The value of an enum by its number.
fn known<T: TryFrom<i32>>(field: &str, number: i32) -> Result<T, ServiceError> {
    T::try_from(number).map_err(|_| {
        ServiceError::malformed(format!("{field} is {number}, which this server does not know"))
    })
}

pub(super) fn refine_mode(number: i32) -> Result<RefineMode, ServiceError> {
    Ok(match known("refine", number)? {
        proto::RefineMode::Unspecified | proto::RefineMode::Async => RefineMode::Async,
        proto::RefineMode::Wait => RefineMode::Wait,
        proto::RefineMode::Off => RefineMode::Off,
    })
}

pub(super) fn priority(number: i32) -> Result<Priority, ServiceError> {
    Ok(match known("priority", number)? {
        proto::Priority::Unspecified | proto::Priority::Normal => Priority::Normal,
        proto::Priority::Low => Priority::Low,
        proto::Priority::High => Priority::High,
    })
}

/// `None` for any.
pub(super) fn job_state(number: i32) -> Result<Option<JobState>, ServiceError> {
    Ok(match known("state", number)? {
        proto::JobState::Unspecified => None,
        proto::JobState::Queued => Some(JobState::Queued),
        proto::JobState::Running => Some(JobState::Running),
        proto::JobState::Succeeded => Some(JobState::Succeeded),
        proto::JobState::Degraded => Some(JobState::Degraded),
        proto::JobState::Failed => Some(JobState::Failed),
        proto::JobState::Cancelled => Some(JobState::Cancelled),
    })
}

pub(super) fn job_state_to(state: JobState) -> proto::JobState {
    match state {
        JobState::Queued => proto::JobState::Queued,
        JobState::Running => proto::JobState::Running,
        JobState::Succeeded => proto::JobState::Succeeded,
        JobState::Degraded => proto::JobState::Degraded,
        JobState::Failed => proto::JobState::Failed,
        JobState::Cancelled => proto::JobState::Cancelled,
    }
}

/// `None` for as it is.
pub(super) fn scene(number: i32) -> Result<Option<Scene>, ServiceError> {
    Ok(match known("scene", number)? {
        proto::Scene::Unspecified => None,
        proto::Scene::Indoor => Some(Scene::Indoor),
        proto::Scene::Outdoor => Some(Scene::Outdoor),
    })
}

/// `None` for as it is.
pub(super) fn descriptor(number: i32) -> Result<Option<DescriptorKind>, ServiceError> {
    Ok(match known("descriptor", number)? {
        proto::Descriptor::Unspecified => None,
        proto::Descriptor::Gem => Some(DescriptorKind::Gem),
        proto::Descriptor::Cls => Some(DescriptorKind::Cls),
    })
}

/// `None` for as it is.
pub(super) fn frame(number: i32) -> Result<Option<Frame>, ServiceError> {
    Ok(match known("frame", number)? {
        proto::Frame::Unspecified => None,
        proto::Frame::Wgs84 => Some(Frame::Wgs84),
        proto::Frame::Metric => Some(Frame::Metric),
    })
}

pub(super) fn moment(moment: prost_types::Timestamp) -> Result<Timestamp, ServiceError> {
    Timestamp::new(moment.seconds, moment.nanos)
        .map_err(|error| ServiceError::unprocessable(format!("captured_at: {error}")))
}

fn moment_to(moment: Timestamp) -> prost_types::Timestamp {
    const SECOND: i128 = 1_000_000_000;
    let nanos = moment.as_nanosecond();
    prost_types::Timestamp {
        seconds: nanos.div_euclid(SECOND) as i64,
        nanos: nanos.rem_euclid(SECOND) as i32,
    }
}

/// A pose in the form in which the service checks it against the map.
pub(super) fn pose(pose: proto::Pose) -> Result<Value, ServiceError> {
    let fields = match pose.frame {
        None => Vec::new(),
        Some(proto::pose::Frame::Geographic(pose)) => vec![
            ("lat", Some(pose.lat)),
            ("lon", Some(pose.lon)),
            ("alt", pose.alt),
            ("heading", pose.heading),
        ],
        Some(proto::pose::Frame::Metric(pose)) => {
            let part = |of: fn(&proto::Quaternion) -> f64| pose.orientation.as_ref().map(of);
            vec![
                ("x", Some(pose.x)),
                ("y", Some(pose.y)),
                ("z", pose.z),
                ("qx", part(|q| q.x)),
                ("qy", part(|q| q.y)),
                ("qz", part(|q| q.z)),
                ("qw", part(|q| q.w)),
            ]
        }
    };
    let mut given = JsonObject::new();
    for (field, value) in fields {
        let Some(value) = value else { continue };
        // JSON has no word for it.
        if !value.is_finite() {
            let detail = format!("{field} is {value}; it must be a number");
            return Err(ServiceError::unprocessable(detail));
        }
        given.insert(field.to_owned(), value.into());
    }
    Ok(Value::Object(given))
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
        }
    }
}

impl From<Answer> for proto::LocalizeResponse {
    fn from(answer: Answer) -> Self {
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

impl From<Job> for proto::Job {
    fn from(job: Job) -> Self {
        let refiner = match job.refiner {
            RefinerKind::Local => proto::Refiner::Local,
            RefinerKind::Mllm => proto::Refiner::Mllm,
        };
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
            refiner: refiner.into(),
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
        }
    }
}

impl From<MapState> for proto::Map {
    fn from(map: MapState) -> Self {
        let scene = match map.scene {
            Scene::Indoor => proto::Scene::Indoor,
            Scene::Outdoor => proto::Scene::Outdoor,
        };
        let descriptor = match map.descriptor {
            DescriptorKind::Gem => proto::Descriptor::Gem,
            DescriptorKind::Cls => proto::Descriptor::Cls,
        };
        let frame = match map.frame {
            Frame::Wgs84 => proto::Frame::Wgs84,
            Frame::Metric => proto::Frame::Metric,
        };
        let index = match map.index {
            IndexKind::Exact => proto::Index::Exact,
            IndexKind::Building => proto::Index::Building,
            IndexKind::Hnsw => proto::Index::Hnsw,
        };
        Self {
            name: map.name.into(),
            scene: scene.into(),
            descriptor: descriptor.into(),
            frame: frame.into(),
            model: map.model,
            model_digest: map.model_digest.to_string(),
            dim: map.dim as u32,
            images: map.images as u64,
            index: index.into(),
            description: map.description.unwrap_or_default(),
            created_at: Some(moment_to(map.created_at)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_comes_back_as_it_was_sent() {
        let sent = proto::Pose {
            frame: Some(proto::pose::Frame::Metric(proto::MetricPose {
                x: 1.5,
                y: -2.0,
                z: None,
                orientation: Some(proto::Quaternion { x: 0.0, y: 0.0, z: 0.6, w: 0.8 }),
            })),
        };
        let read = Pose::from_json(Frame::Metric, pose(sent).unwrap()).unwrap();
        assert_eq!(proto::Pose::from(read), sent);
        assert!(Pose::from_json(Frame::Wgs84, pose(sent).unwrap()).is_err());
        assert!(
            Pose::from_json(Frame::Metric, pose(proto::Pose { frame: None }).unwrap()).is_err()
        );
        let nowhere = proto::MetricPose { x: 0.0, y: 0.0, z: Some(f64::NAN), orientation: None };
        let nowhere = proto::Pose { frame: Some(proto::pose::Frame::Metric(nowhere)) };
        assert!(pose(nowhere).unwrap_err().detail.contains('z'));
    }

    #[test]
    fn moments_before_1970_have_positive_nanoseconds() {
        let at: Timestamp = "1969-12-31T23:59:59.25Z".parse().unwrap();
        let message = moment_to(at);
        assert_eq!((message.seconds, message.nanos), (-1, 250_000_000));
        assert_eq!(moment(message).unwrap(), at);
    }
}
