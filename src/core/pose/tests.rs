//! Validation, distances and round trips of poses.

use proptest::option;
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;

fn read(frame: CoordinateFrame, pose: Value) -> Result<Pose, PoseError> {
    serde_json::from_value::<PoseInput>(pose).unwrap().check(frame)
}

#[test]
fn a_pose_out_of_range_names_the_field_and_the_range() {
    let error = read(CoordinateFrame::Wgs84, json!({"lat": 91.0, "lon": 0.0})).unwrap_err();
    assert_eq!(error.to_string(), "lat is 91; it must be between -90 and 90 degrees");
    assert!(read(CoordinateFrame::Metric, json!({"x": 1e9, "y": 0.0})).is_err());
}

#[test]
fn a_pose_of_the_wrong_frame_names_the_expected_fields() {
    let error = read(CoordinateFrame::Wgs84, json!({"x": 1.0, "y": 2.0})).unwrap_err();
    assert!(error.to_string().contains("takes lat, lon"), "{error}");
    let error = read(CoordinateFrame::Metric, json!({"lat": 1.0, "lon": 2.0})).unwrap_err();
    assert!(error.to_string().contains("takes x, y"), "{error}");
}

#[test]
fn a_missing_coordinate_is_named() {
    let error = read(CoordinateFrame::Wgs84, json!({"lat": 1.0})).unwrap_err();
    assert!(error.to_string().ends_with("missing field `lon`"), "{error}");
    assert!(read(CoordinateFrame::Metric, json!({})).is_err());
}

#[test]
fn nan_and_infinity_are_out_of_range() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let pose = PoseInput { lat: Some(bad), lon: Some(0.0), ..PoseInput::default() };
        assert!(pose.check(CoordinateFrame::Wgs84).is_err());
        let pose = PoseInput { x: Some(0.0), y: Some(0.0), z: Some(bad), ..PoseInput::default() };
        assert!(pose.check(CoordinateFrame::Metric).is_err());
        let turned = PoseInput {
            x: Some(0.0),
            y: Some(0.0),
            qx: Some(bad),
            qy: Some(0.0),
            qz: Some(0.0),
            qw: Some(1.0),
            ..PoseInput::default()
        };
        assert!(turned.check(CoordinateFrame::Metric).is_err());
    }
}

#[test]
fn a_checked_pose_converts_back_to_its_input() {
    let pose = read(CoordinateFrame::Metric, json!({"x": 1.5, "y": -2.0, "z": 3.0})).unwrap();
    assert_eq!(PoseInput::from(pose).check(CoordinateFrame::Metric), Ok(pose));
    assert_eq!(PoseInput::from(pose).frame(), Some(CoordinateFrame::Metric));
}

#[test]
fn an_orientation_is_complete_and_of_unit_norm() {
    let with =
        |q: [f64; 4]| json!({"x": 0, "y": 0, "qx": q[0], "qy": q[1], "qz": q[2], "qw": q[3]});
    assert!(read(CoordinateFrame::Metric, with([0.0, 0.0, 0.6, 0.8])).is_ok());
    assert!(read(CoordinateFrame::Metric, with([0.0, 0.0, 0.6, 0.6])).is_err());
    assert!(read(CoordinateFrame::Metric, json!({"x": 0, "y": 0, "qw": 1})).is_err());
}

#[test]
fn a_degree_of_latitude_is_111_kilometres() {
    let at = |lat| Pose::Geographic(GeographicPose { lat, lon: 139.7, alt: None, heading: None });
    let distance = at(35.0).distance_m(&at(36.0)).unwrap();
    assert!((distance - 111_195.0).abs() < 10.0, "{distance}");
}

#[test]
fn poses_of_different_frames_have_no_distance() {
    let metric = read(CoordinateFrame::Metric, json!({"x": 3.0, "y": 4.0})).unwrap();
    let origin = read(CoordinateFrame::Metric, json!({"x": 0.0, "y": 0.0})).unwrap();
    let globe = read(CoordinateFrame::Wgs84, json!({"lat": 0.0, "lon": 0.0})).unwrap();
    assert_eq!(metric.distance_m(&origin), Some(5.0));
    assert_eq!(metric.distance_m(&globe), None);
}

fn geographic() -> impl Strategy<Value = Pose> {
    let alt = option::of(-MAX_COORDINATE_M..=MAX_COORDINATE_M);
    (-90.0..=90.0, -180.0..=180.0, alt, option::of(0.0..=360.0)).prop_map(
        |(lat, lon, alt, heading)| Pose::Geographic(GeographicPose { lat, lon, alt, heading }),
    )
}

fn metric() -> impl Strategy<Value = Pose> {
    let metres = || -MAX_COORDINATE_M..=MAX_COORDINATE_M;
    let unit = [-1.0..=1.0, -1.0..=1.0, -1.0..=1.0, 0.1..=1.0_f64].prop_map(|q| {
        let norm = q.iter().map(|part| part * part).sum::<f64>().sqrt();
        q.map(|part| part / norm)
    });
    (metres(), metres(), option::of(metres()), option::of(unit)).prop_map(|(x, y, z, q)| {
        let [qx, qy, qz, qw] = q.map_or([None; 4], |q| q.map(Some));
        Pose::Metric(MetricPose { x, y, z, qx, qy, qz, qw })
    })
}

fn any_input() -> impl Strategy<Value = PoseInput> {
    let number = || option::of(prop_oneof![any::<f64>(), -2.0..2.0_f64]);
    let [place, more] = [0, 1].map(|_| (number(), number(), number(), number()));
    (place, more, (number(), number(), number())).prop_map(
        |((lat, lon, alt, heading), (x, y, z, qx), (qy, qz, qw))| PoseInput {
            lat,
            lon,
            alt,
            heading,
            x,
            y,
            z,
            qx,
            qy,
            qz,
            qw,
        },
    )
}

proptest! {
    #[test]
    fn a_valid_pose_round_trips_through_json(pose in prop_oneof![geographic(), metric()]) {
        let text = serde_json::to_string(&pose).unwrap();
        prop_assert_eq!(serde_json::from_str::<Pose>(&text).unwrap(), pose);
        let input: PoseInput = serde_json::from_str(&text).unwrap();
        prop_assert_eq!(input, PoseInput::from(pose));
        prop_assert_eq!(input.frame(), Some(pose.frame()));
        prop_assert_eq!(input.check(pose.frame()), Ok(pose));
    }

    #[test]
    fn checking_never_changes_a_number(input in any_input(), is_metric: bool) {
        let frame = if is_metric { CoordinateFrame::Metric } else { CoordinateFrame::Wgs84 };
        if let Ok(pose) = input.check(frame) {
            prop_assert_eq!(pose.frame(), frame);
            prop_assert_eq!(pose.checked(), Ok(pose));
            prop_assert_eq!(PoseInput::from(pose), input);
        }
    }

    #[test]
    fn distance_is_symmetric_and_at_most_half_the_circumference(
        (a, b) in prop_oneof![(geographic(), geographic()), (metric(), metric())],
    ) {
        let distance = a.distance_m(&b).unwrap();
        prop_assert!((distance - b.distance_m(&a).unwrap()).abs() <= 1e-6 * distance.max(1.0));
        prop_assert_eq!(a.distance_m(&a), Some(0.0));
        if let Pose::Geographic(_) = a {
            prop_assert!(distance <= std::f64::consts::PI * EARTH_RADIUS_M + 1.0);
        }
    }
}
