//! Converts between the messages of the contract and the types of the service.

use jiff::Timestamp;

use super::proto;
use whereabouts_api::{MapRefiner, RefineMode};
use whereabouts_core::{
    CoordinateFrame, JobState, PoseInput, Priority, Recording, RefinerKind, Scene,
};
use whereabouts_service::ServiceError;

/// Converts the number of an enum; an unknown one is malformed.
fn enum_value<T: TryFrom<i32>>(field: &str, number: i32) -> Result<T, ServiceError> {
    T::try_from(number).map_err(|_| {
        ServiceError::malformed(format!("{field} is {number}, which this server does not know"))
    })
}

pub(super) fn refine_mode(number: i32) -> Result<RefineMode, ServiceError> {
    Ok(match enum_value("refine", number)? {
        proto::RefineMode::Unspecified | proto::RefineMode::Async => RefineMode::Async,
        proto::RefineMode::Wait => RefineMode::Wait,
        proto::RefineMode::Off => RefineMode::Off,
    })
}

pub(super) fn priority(number: i32) -> Result<Priority, ServiceError> {
    Ok(match enum_value("priority", number)? {
        proto::Priority::Unspecified | proto::Priority::Normal => Priority::Normal,
        proto::Priority::Low => Priority::Low,
        proto::Priority::High => Priority::High,
    })
}

/// `None` stands for that of the map or of the server.
pub(super) fn refiner(number: i32) -> Result<Option<RefinerKind>, ServiceError> {
    Ok(match enum_value("refiner", number)? {
        proto::Refiner::Unspecified => None,
        proto::Refiner::Local => Some(RefinerKind::Local),
        proto::Refiner::Cascade => Some(RefinerKind::Cascade),
        proto::Refiner::Mllm => Some(RefinerKind::Mllm),
    })
}

/// `None` leaves it unchanged.
pub(super) fn map_refiner(number: Option<i32>) -> Result<Option<MapRefiner>, ServiceError> {
    let Some(number) = number else { return Ok(None) };
    Ok(Some(match refiner(number)? {
        None => MapRefiner::Default,
        Some(RefinerKind::Local) => MapRefiner::Local,
        Some(RefinerKind::Cascade) => MapRefiner::Cascade,
        Some(RefinerKind::Mllm) => MapRefiner::Mllm,
    }))
}

/// `None` stands for any state.
pub(super) fn job_state(number: i32) -> Result<Option<JobState>, ServiceError> {
    Ok(match enum_value("state", number)? {
        proto::JobState::Unspecified => None,
        proto::JobState::Queued => Some(JobState::Queued),
        proto::JobState::Running => Some(JobState::Running),
        proto::JobState::Succeeded => Some(JobState::Succeeded),
        proto::JobState::Degraded => Some(JobState::Degraded),
        proto::JobState::Failed => Some(JobState::Failed),
        proto::JobState::Cancelled => Some(JobState::Cancelled),
    })
}

/// `None` leaves it unchanged.
pub(super) fn scene(number: i32) -> Result<Option<Scene>, ServiceError> {
    Ok(match enum_value("scene", number)? {
        proto::Scene::Unspecified => None,
        proto::Scene::Indoor => Some(Scene::Indoor),
        proto::Scene::Outdoor => Some(Scene::Outdoor),
    })
}

/// `None` leaves it unchanged.
pub(super) fn frame(number: i32) -> Result<Option<CoordinateFrame>, ServiceError> {
    Ok(match enum_value("frame", number)? {
        proto::Frame::Unspecified => None,
        proto::Frame::Wgs84 => Some(CoordinateFrame::Wgs84),
        proto::Frame::Metric => Some(CoordinateFrame::Metric),
    })
}

pub(super) fn moment(moment: prost_types::Timestamp) -> Result<Timestamp, ServiceError> {
    Timestamp::new(moment.seconds, moment.nanos)
        .map_err(|error| ServiceError::unprocessable(format!("captured_at: {error}")))
}

pub(super) fn recording(recording: proto::Recording) -> Result<Recording, ServiceError> {
    let id = recording.id.parse().map_err(|error: uuid::Error| {
        ServiceError::unprocessable(format!("recording.id must be a UUID: {error}"))
    })?;
    Ok(Recording { id, number: recording.number })
}

/// An error of one item among several.
pub(super) fn problem(error: ServiceError) -> proto::Problem {
    proto::Problem {
        kind: error.kind.word().to_owned(),
        detail: error.detail,
        // No wait is too long for a duration of protobuf.
        retry_after: error.retry_after.and_then(|pause| pause.try_into().ok()),
    }
}

/// A pose as the service checks it against the frame of the map.
pub(super) fn pose(pose: proto::Pose) -> PoseInput {
    match pose.frame {
        None => PoseInput::default(),
        Some(proto::pose::Frame::Geographic(pose)) => PoseInput {
            lat: Some(pose.lat),
            lon: Some(pose.lon),
            alt: pose.alt,
            heading: pose.heading,
            ..PoseInput::default()
        },
        Some(proto::pose::Frame::Metric(pose)) => {
            let part = |of: fn(&proto::Quaternion) -> f64| pose.orientation.as_ref().map(of);
            PoseInput {
                x: Some(pose.x),
                y: Some(pose.y),
                z: pose.z,
                qx: part(|q| q.x),
                qy: part(|q| q.y),
                qz: part(|q| q.z),
                qw: part(|q| q.w),
                ..PoseInput::default()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_api::moment_to;

    #[test]
    fn a_pose_survives_the_round_trip() {
        let sent = proto::Pose {
            frame: Some(proto::pose::Frame::Metric(proto::MetricPose {
                x: 1.5,
                y: -2.0,
                z: None,
                orientation: Some(proto::Quaternion { x: 0.0, y: 0.0, z: 0.6, w: 0.8 }),
            })),
        };
        let read = pose(sent).check(CoordinateFrame::Metric).unwrap();
        assert_eq!(proto::Pose::from(read), sent);
        assert!(pose(sent).check(CoordinateFrame::Wgs84).is_err());
        assert!(pose(proto::Pose { frame: None }).check(CoordinateFrame::Metric).is_err());
        let nowhere = proto::MetricPose { x: 0.0, y: 0.0, z: Some(f64::NAN), orientation: None };
        let nowhere = proto::Pose { frame: Some(proto::pose::Frame::Metric(nowhere)) };
        let error = pose(nowhere).check(CoordinateFrame::Metric).unwrap_err();
        assert!(error.to_string().starts_with("z is NaN"), "{error}");
    }

    #[test]
    fn times_before_1970_have_positive_nanoseconds() {
        let at: Timestamp = "1969-12-31T23:59:59.25Z".parse().unwrap();
        let message = moment_to(at);
        assert_eq!((message.seconds, message.nanos), (-1, 250_000_000));
        assert_eq!(moment(message).unwrap(), at);
    }
}
