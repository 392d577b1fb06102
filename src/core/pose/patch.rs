//! Changes of single numbers of a pose.

use serde::{Deserialize, Deserializer, Serialize};
use utoipa::ToSchema;

use super::{Pose, PoseInput};

/// A change of a pose (JSON merge patch, RFC 7396): an omitted number keeps its value, and null removes it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct PosePatch {
    /// Latitude in degrees.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub lat: Option<Option<f64>>,
    /// Longitude in degrees.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub lon: Option<Option<f64>>,
    /// Height above the ellipsoid in metres.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub alt: Option<Option<f64>>,
    /// Viewing direction in degrees clockwise from north.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub heading: Option<Option<f64>>,
    /// Metres along the x axis.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub x: Option<Option<f64>>,
    /// Metres along the y axis.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub y: Option<Option<f64>>,
    /// Metres along the z axis.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub z: Option<Option<f64>>,
    /// Orientation: x component of the unit quaternion.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub qx: Option<Option<f64>>,
    /// Orientation: y component.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub qy: Option<Option<f64>>,
    /// Orientation: z component.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub qz: Option<Option<f64>>,
    /// Orientation: scalar component.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>)]
    pub qw: Option<Option<f64>>,
}

/// Distinguishes null from an omitted field.
fn given<'de, D: Deserializer<'de>>(number: D) -> Result<Option<Option<f64>>, D::Error> {
    Option::deserialize(number).map(Some)
}

impl PosePatch {
    /// The numbers of a pose after the change, to be validated with [`PoseInput::check`].
    pub fn applied_to(&self, pose: Option<Pose>) -> PoseInput {
        let old = pose.map(PoseInput::from).unwrap_or_default();
        PoseInput {
            lat: self.lat.unwrap_or(old.lat),
            lon: self.lon.unwrap_or(old.lon),
            alt: self.alt.unwrap_or(old.alt),
            heading: self.heading.unwrap_or(old.heading),
            x: self.x.unwrap_or(old.x),
            y: self.y.unwrap_or(old.y),
            z: self.z.unwrap_or(old.z),
            qx: self.qx.unwrap_or(old.qx),
            qy: self.qy.unwrap_or(old.qy),
            qz: self.qz.unwrap_or(old.qz),
            qw: self.qw.unwrap_or(old.qw),
        }
    }
}

impl From<PoseInput> for PosePatch {
    /// The change that replaces any pose by these numbers as a whole.
    fn from(pose: PoseInput) -> Self {
        let PoseInput { lat, lon, alt, heading, x, y, z, qx, qy, qz, qw } = pose;
        Self {
            lat: Some(lat),
            lon: Some(lon),
            alt: Some(alt),
            heading: Some(heading),
            x: Some(x),
            y: Some(y),
            z: Some(z),
            qx: Some(qx),
            qy: Some(qy),
            qz: Some(qz),
            qw: Some(qw),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CoordinateFrame;

    fn patched(pose: Option<&str>, patch: &str) -> Result<String, String> {
        let pose = pose.map(|pose| serde_json::from_str(pose).unwrap());
        let patch: PosePatch = serde_json::from_str(patch).unwrap();
        let checked = patch.applied_to(pose).check(CoordinateFrame::Wgs84);
        checked.map(|pose| serde_json::to_string(&pose).unwrap()).map_err(|error| error.to_string())
    }

    #[test]
    fn a_patch_keeps_omitted_numbers_and_removes_nulls() {
        let old = Some(r#"{"lat":1.0,"lon":2.0,"heading":90.0}"#);
        assert_eq!(
            patched(old, r#"{"lat":3.0}"#).unwrap(),
            r#"{"lat":3.0,"lon":2.0,"heading":90.0}"#
        );
        assert_eq!(patched(old, r#"{"heading":null}"#).unwrap(), r#"{"lat":1.0,"lon":2.0}"#);
        assert_eq!(
            patched(old, r#"{"heading":0,"alt":5}"#).unwrap(),
            r#"{"lat":1.0,"lon":2.0,"alt":5.0,"heading":0.0}"#
        );
    }

    #[test]
    fn a_patched_pose_is_validated_as_a_whole() {
        let old = Some(r#"{"lat":1.0,"lon":2.0}"#);
        assert!(patched(old, r#"{"lat":null}"#).unwrap_err().contains("missing field `lat`"));
        assert!(patched(old, r#"{"lat":91}"#).unwrap_err().contains("lat is 91"));
        assert!(patched(old, r#"{"x":1,"y":1}"#).unwrap_err().contains("unknown field `x`"));
        assert!(patched(None, r#"{"heading":9}"#).unwrap_err().contains("missing field `lat`"));
    }

    #[test]
    fn a_whole_pose_replaces_every_number_of_the_old_one() {
        let whole = PoseInput { lat: Some(5.0), lon: Some(6.0), ..PoseInput::default() };
        let old: Pose = serde_json::from_str(r#"{"lat":1.0,"lon":2.0,"heading":90.0}"#).unwrap();
        assert_eq!(PosePatch::from(whole).applied_to(Some(old)), whole);
    }
}
