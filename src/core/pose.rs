//! Camera poses, geographic or in a map's local metric frame.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use self::patch::PosePatch;
use super::CoordinateFrame;

mod patch;

/// The pose of a camera in the coordinate frame of its map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
pub enum Pose {
    /// Pose in a `wgs84` map.
    Geographic(GeographicPose),
    /// Pose in a `metric` map.
    Metric(MetricPose),
}

/// A geographic pose (WGS84).
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

/// A pose in a map's local frame: metres and a unit quaternion.
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
    /// Orientation: x component of the unit quaternion. Give all four components or none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qx: Option<f64>,
    /// Orientation: y component.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qy: Option<f64>,
    /// Orientation: z component.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qz: Option<f64>,
    /// Orientation: scalar component.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qw: Option<f64>,
}

/// The numbers of a pose as sent by a caller, not yet validated against the coordinate frame of a map.
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
    /// Orientation: x component of the unit quaternion.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qx: Option<f64>,
    /// Orientation: y component.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qy: Option<f64>,
    /// Orientation: z component.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qz: Option<f64>,
    /// Orientation: scalar component.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub qw: Option<f64>,
}

/// Why a pose is invalid.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum PoseError {
    /// The fields do not match the map's coordinate frame.
    #[error("the pose does not fit a {frame} map, which takes {expected}: {detail}")]
    Fields {
        /// Coordinate frame of the map.
        frame: &'static str,
        /// Fields of a pose in this frame.
        expected: &'static str,
        /// Which field is missing or unknown.
        detail: String,
    },
    /// A value is out of range.
    #[error("{field} is {value}; it must be {range}")]
    Range {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        value: f64,
        /// The valid range.
        range: &'static str,
    },
    /// The orientation is incomplete or not a unit quaternion.
    #[error("{0}")]
    Quaternion(&'static str),
}

/// Mean radius of the Earth in metres (IUGG).
pub const EARTH_RADIUS_M: f64 = 6_371_008.8;

/// Coordinates beyond this distance from the origin are rejected as typing errors.
const MAX_COORDINATE_M: f64 = 1e8;

impl PoseInput {
    /// Whether no number is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// The coordinate frame that the numbers belong to, judged by which pair of coordinates is set; `None` if
    /// neither or both pairs are.
    pub fn frame(&self) -> Option<CoordinateFrame> {
        match (self.lat.is_some() && self.lon.is_some(), self.x.is_some() && self.y.is_some()) {
            (true, false) => Some(CoordinateFrame::Wgs84),
            (false, true) => Some(CoordinateFrame::Metric),
            _ => None,
        }
    }

    /// Validates the numbers for a map with this coordinate frame. Fails if a number is missing, belongs to
    /// another frame, or is out of range.
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
    /// The coordinate frame of the pose.
    pub fn frame(&self) -> CoordinateFrame {
        match self {
            Self::Geographic(_) => CoordinateFrame::Wgs84,
            Self::Metric(_) => CoordinateFrame::Metric,
        }
    }

    /// Validates a pose that was constructed in code.
    pub fn checked(self) -> Result<Self, PoseError> {
        match self {
            Self::Geographic(pose) => pose.checked(),
            Self::Metric(pose) => pose.checked(),
        }
    }

    /// Distance in metres to another pose; `None` if the two are in different kinds of frames.
    ///
    /// For geographic poses this is the great-circle distance by the haversine formula on a sphere with
    /// the mean Earth radius of 6,371,008.8 m (IUGG), accurate to 0.6 %.
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
        within("alt", self.alt, -MAX_COORDINATE_M, MAX_COORDINATE_M, "within 100,000 km")?;
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
            within(field, value, -MAX_COORDINATE_M, MAX_COORDINATE_M, "within 100,000 km")?;
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
mod tests;
