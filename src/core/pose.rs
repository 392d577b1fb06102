//! Where a camera stood: on the globe or in a map's own metric frame.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::CoordinateFrame;

/// Where a camera stood, in the frame of its map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
pub enum Pose {
    /// In a `wgs84` map.
    Geographic(GeographicPose),
    /// In a `metric` map.
    Metric(MetricPose),
}

/// A pose on the globe (WGS84).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct GeographicPose {
    /// Latitude in degrees, −90 to 90.
    pub lat: f64,
    /// Longitude in degrees, −180 to 180.
    pub lon: f64,
    /// Height above the ellipsoid in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alt: Option<f64>,
    /// Viewing direction in degrees clockwise from north, 0 to 360.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heading: Option<f64>,
}

/// A pose in a map's own frame: metres and a unit quaternion.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MetricPose {
    /// Metres along the frame's x axis.
    pub x: f64,
    /// Metres along the frame's y axis.
    pub y: f64,
    /// Metres along the frame's z axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub z: Option<f64>,
    /// Orientation, x part of the unit quaternion; all four parts are given or none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qx: Option<f64>,
    /// Orientation, y part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qy: Option<f64>,
    /// Orientation, z part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qz: Option<f64>,
    /// Orientation, scalar part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qw: Option<f64>,
}

/// The numbers of a pose as a caller sent them: not yet checked against the frame of a map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseInput {
    /// Latitude in degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lat: Option<f64>,
    /// Longitude in degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lon: Option<f64>,
    /// Height above the ellipsoid in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alt: Option<f64>,
    /// Viewing direction in degrees clockwise from north.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heading: Option<f64>,
    /// Metres along the x axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub x: Option<f64>,
    /// Metres along the y axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub y: Option<f64>,
    /// Metres along the z axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub z: Option<f64>,
    /// Orientation, x part of the unit quaternion.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qx: Option<f64>,
    /// Orientation, y part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qy: Option<f64>,
    /// Orientation, z part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qz: Option<f64>,
    /// Orientation, scalar part.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qw: Option<f64>,
}

/// Why a pose was refused.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum PoseError {
    /// The fields are not those of the map's frame.
    #[error("the pose does not fit a {frame} map, which takes {expected}: {detail}")]
    Fields {
        /// The map's frame.
        frame: &'static str,
        /// The fields that a pose of this frame has.
        expected: &'static str,
        /// What the reader said.
        detail: String,
    },
    /// A number lies outside its range.
    #[error("{field} is {value}; it must be {range}")]
    Range {
        /// The field.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What it may be.
        range: &'static str,
    },
    /// The orientation is given in part, or is not a unit quaternion.
    #[error("{0}")]
    Quaternion(&'static str),
}

/// Mean radius of the Earth in metres (IUGG).
pub const EARTH_RADIUS_M: f64 = 6_371_008.8;

/// Farther from the origin than any building, city or orbit of the Earth; keeps typing errors out.
const FARTHEST_METRES: f64 = 1e8;

impl PoseInput {
    /// Whether no number is given.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// The coordinate frame that the numbers belong to, by the pair of coordinates that is given; `None` if
    /// neither or both pairs are.
    pub fn frame(&self) -> Option<CoordinateFrame> {
        match (self.lat.is_some() && self.lon.is_some(), self.x.is_some() && self.y.is_some()) {
            (true, false) => Some(CoordinateFrame::Wgs84),
            (false, true) => Some(CoordinateFrame::Metric),
            _ => None,
        }
    }

    /// The pose in a map of this frame. Fails if a number is missing, belongs to another frame, or is out of
    /// range.
    pub fn check(self, frame: CoordinateFrame) -> Result<Pose, PoseError> {
        let Self { lat, lon, alt, heading, x, y, z, qx, qy, qz, qw } = self;
        let geographic = [("lat", lat), ("lon", lon), ("alt", alt), ("heading", heading)];
        let metric = [("x", x), ("y", y), ("z", z), ("qx", qx), ("qy", qy), ("qz", qz), ("qw", qw)];
        let (name, expected, foreign): (_, _, &[(&str, Option<f64>)]) = match frame {
            CoordinateFrame::Wgs84 => ("wgs84", "lat, lon and, if known, alt and heading", &metric),
            CoordinateFrame::Metric => {
                ("metric", "x, y and, if known, z, qx, qy, qz, qw", &geographic)
            }
        };
        let misfit = |detail: String| PoseError::Fields { frame: name, expected, detail };
        if let Some((field, _)) = foreign.iter().find(|(_, value)| value.is_some()) {
            return Err(misfit(format!("unknown field `{field}`")));
        }
        let required = |field: &str, value: Option<f64>| {
            value.ok_or_else(|| misfit(format!("missing field `{field}`")))
        };
        match frame {
            CoordinateFrame::Wgs84 => GeographicPose {
                lat: required("lat", lat)?,
                lon: required("lon", lon)?,
                alt,
                heading,
            }
            .checked(),
            CoordinateFrame::Metric => {
                MetricPose { x: required("x", x)?, y: required("y", y)?, z, qx, qy, qz, qw }
                    .checked()
            }
        }
    }
}

impl From<Pose> for PoseInput {
    fn from(pose: Pose) -> Self {
        match pose {
            Pose::Geographic(GeographicPose { lat, lon, alt, heading }) => {
                Self { lat: Some(lat), lon: Some(lon), alt, heading, ..Self::default() }
            }
            Pose::Metric(MetricPose { x, y, z, qx, qy, qz, qw }) => {
                Self { x: Some(x), y: Some(y), z, qx, qy, qz, qw, ..Self::default() }
            }
        }
    }
}

impl Pose {
    /// The frame it belongs to.
    pub fn frame(&self) -> CoordinateFrame {
        match self {
            Self::Geographic(_) => CoordinateFrame::Wgs84,
            Self::Metric(_) => CoordinateFrame::Metric,
        }
    }

    /// Checks the ranges of a pose that was built in code.
    pub fn checked(self) -> Result<Self, PoseError> {
        match self {
            Self::Geographic(pose) => pose.checked(),
            Self::Metric(pose) => pose.checked(),
        }
    }

    /// Distance in metres to another pose of the same frame, `None` across frames.
    ///
    /// On the globe this is the great-circle distance of the haversine formula over a sphere of
    /// the mean Earth radius 6,371,008.8 m (IUGG), good to 0.6 %.
    pub fn distance_m(&self, other: &Self) -> Option<f64> {
        match (self, other) {
            (Self::Geographic(a), Self::Geographic(b)) => Some(a.haversine_m(b)),
            (Self::Metric(a), Self::Metric(b)) => {
                let dz = a.z.zip(b.z).map_or(0.0, |(a, b)| a - b);
                Some(((a.x - b.x).powi(2) + (a.y - b.y).powi(2) + dz.powi(2)).sqrt())
            }
            _ => None,
        }
    }
}

impl GeographicPose {
    fn checked(self) -> Result<Pose, PoseError> {
        within("lat", Some(self.lat), -90.0, 90.0, "between -90 and 90 degrees")?;
        within("lon", Some(self.lon), -180.0, 180.0, "between -180 and 180 degrees")?;
        within("alt", self.alt, -FARTHEST_METRES, FARTHEST_METRES, "within 100,000 km")?;
        within("heading", self.heading, 0.0, 360.0, "between 0 and 360 degrees")?;
        Ok(Pose::Geographic(self))
    }

    fn haversine_m(&self, other: &Self) -> f64 {
        let (a, b) = (self.lat.to_radians(), other.lat.to_radians());
        let half_lat = ((b - a) / 2.0).sin();
        let half_lon = ((other.lon - self.lon).to_radians() / 2.0).sin();
        let h = half_lat.powi(2) + a.cos() * b.cos() * half_lon.powi(2);
        2.0 * EARTH_RADIUS_M * h.sqrt().min(1.0).asin()
    }
}

impl MetricPose {
    fn checked(self) -> Result<Pose, PoseError> {
        for (field, value) in [("x", Some(self.x)), ("y", Some(self.y)), ("z", self.z)] {
            within(field, value, -FARTHEST_METRES, FARTHEST_METRES, "within 100,000 km")?;
        }
        match [self.qx, self.qy, self.qz, self.qw] {
            [None, None, None, None] => {}
            [Some(x), Some(y), Some(z), Some(w)] => {
                let norm = (x * x + y * y + z * z + w * w).sqrt();
                let is_unit = (norm - 1.0).abs() < 1e-3;
                if !is_unit {
                    return Err(PoseError::Quaternion(
                        "qx, qy, qz, qw must be a unit quaternion (norm 1 to within 0.001)",
                    ));
                }
            }
            _ => {
                return Err(PoseError::Quaternion(
                    "an orientation needs all of qx, qy, qz and qw, or none of them",
                ));
            }
        }
        Ok(Pose::Metric(self))
    }
}

fn within(
    field: &'static str,
    value: Option<f64>,
    low: f64,
    high: f64,
    range: &'static str,
) -> Result<(), PoseError> {
    match value {
        Some(value) if !(low..=high).contains(&value) => {
            Err(PoseError::Range { field, value, range })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

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
    fn a_pose_of_the_other_frame_says_what_this_map_takes() {
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
            let pose =
                PoseInput { x: Some(0.0), y: Some(0.0), z: Some(bad), ..PoseInput::default() };
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
    fn a_checked_pose_survives_the_way_back() {
        let pose = read(CoordinateFrame::Metric, json!({"x": 1.5, "y": -2.0, "z": 3.0})).unwrap();
        assert_eq!(PoseInput::from(pose).check(CoordinateFrame::Metric), Ok(pose));
        assert_eq!(PoseInput::from(pose).frame(), Some(CoordinateFrame::Metric));
    }

    #[test]
    fn an_orientation_is_whole_and_of_unit_norm() {
        let with =
            |q: [f64; 4]| json!({"x": 0, "y": 0, "qx": q[0], "qy": q[1], "qz": q[2], "qw": q[3]});
        assert!(read(CoordinateFrame::Metric, with([0.0, 0.0, 0.6, 0.8])).is_ok());
        assert!(read(CoordinateFrame::Metric, with([0.0, 0.0, 0.6, 0.6])).is_err());
        assert!(read(CoordinateFrame::Metric, json!({"x": 0, "y": 0, "qw": 1})).is_err());
    }

    #[test]
    fn a_degree_of_latitude_is_111_kilometres() {
        let at =
            |lat| Pose::Geographic(GeographicPose { lat, lon: 139.7, alt: None, heading: None });
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
}
