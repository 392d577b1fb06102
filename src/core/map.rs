//! Maps: named sets of reference images that share a model, a descriptor kind and a coordinate frame.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use super::{DescriptorKind, Digest, InvalidName, RefinerKind};

/// The name of a map: 1 to 64 of `a-z 0-9 . _ -`, starting with a letter or a digit.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "String", into = "String")]
pub struct MapName(String);

impl MapName {
    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for MapName {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        let allowed = |b: u8| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'.' | b'_' | b'-');
        let starts = text.bytes().next().is_some_and(|b| b.is_ascii_alphanumeric());
        if text.len() > 64 || !starts || !text.bytes().all(allowed) {
            return Err(InvalidName(format!(
                "a map name is 1 to 64 of a-z, 0-9, '.', '_' and '-', starting with a letter or a \
                 digit; got {:?}",
                text.chars().take(80).collect::<String>()
            )));
        }
        Ok(Self(text.to_owned()))
    }
}

impl TryFrom<String> for MapName {
    type Error = InvalidName;

    fn try_from(text: String) -> Result<Self, InvalidName> {
        text.parse()
    }
}

impl From<MapName> for String {
    fn from(name: MapName) -> Self {
        name.0
    }
}

impl fmt::Display for MapName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The kind of environment that a map covers. It selects the wording of the refiner's prompts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Scene {
    /// Streets, yards, fields.
    #[default]
    Outdoor,
    /// Corridors, halls, shops.
    Indoor,
}

/// The coordinate frame of a map's poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = Frame)]
pub enum CoordinateFrame {
    /// Latitude and longitude in degrees.
    #[default]
    Wgs84,
    /// Metres in a local Cartesian frame.
    Metric,
}

/// The numeric precision at which a model runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32-bit floats.
    #[default]
    Full,
    /// bfloat16 inside the model, 32-bit floats at its inputs and outputs.
    Bf16,
}

macro_rules! display_as_written {
    ($type:ty { $($variant:ident => $text:literal),+ }) => {
        impl $type {
            /// The name used in the API.
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.as_str())
            }
        }

        impl FromStr for $type {
            type Err = InvalidName;

            fn from_str(text: &str) -> Result<Self, InvalidName> {
                match text {
                    $($text => Ok(Self::$variant),)+
                    _ => Err(InvalidName(format!(
                        "expected one of {}; got {text:?}", [$($text),+].join(", ")
                    ))),
                }
            }
        }
    };
}
pub(super) use display_as_written;

display_as_written!(Scene { Outdoor => "outdoor", Indoor => "indoor" });
display_as_written!(Precision { Full => "full", Bf16 => "bf16" });
display_as_written!(CoordinateFrame { Wgs84 => "wgs84", Metric => "metric" });

/// The record of a map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Map {
    /// Distinguishes this map from a deleted map of the same name.
    pub uid: Uuid,
    /// Name of the map.
    pub name: MapName,
    /// Indoor or outdoor.
    pub scene: Scene,
    /// Kind of descriptor that is compared.
    pub descriptor: DescriptorKind,
    /// Coordinate frame of the poses.
    pub frame: CoordinateFrame,
    /// Name of the model that computes the descriptors.
    pub model: String,
    /// Digest of everything that determines a descriptor of this kind: the model's weights, preprocessing and
    /// pooling. Descriptors with different digests are not comparable.
    #[schema(value_type = String)]
    pub model_digest: Digest,
    /// Precision at which the model runs.
    #[serde(default)]
    pub precision: Precision,
    /// Dimension of the descriptors.
    pub dim: usize,
    /// Number of completed reindexes.
    #[serde(default)]
    pub revision: u32,
    /// The refiner of its jobs; the server's if it names none. Requests may choose one that costs no more.
    #[serde(default)]
    pub refiner: Option<RefinerKind>,
    /// The vocabulary that was fitted on the map's own images, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vocabulary: Option<MapVocabulary>,
    /// Whether the map stays with the vocabulary of the model.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub keeps_shipped: bool,
    /// Free text for people.
    #[serde(default)]
    pub description: Option<String>,
    /// When the map was created.
    pub created_at: Timestamp,
}

/// A vocabulary that was fitted on the images of one map. Its bytes are a blob of the store.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MapVocabulary {
    /// SHA-256 of the vocabulary.
    #[schema(value_type = String)]
    pub digest: Digest,
    /// When it was fitted.
    pub fitted_at: Timestamp,
    /// Number of images that it was fitted on.
    pub images: usize,
    /// Number of images that the map had then.
    pub of: usize,
    /// Whether it was asked for. Otherwise the map returns to the model's vocabulary where that is better.
    pub requested: bool,
}

impl Map {
    /// Whether descriptors of the two maps are comparable: same model, precision, descriptor kind and
    /// dimension.
    pub fn is_compatible_with(&self, other: &Self) -> bool {
        self.model == other.model
            && self.model_digest == other.model_digest
            && self.precision == other.precision
            && self.descriptor == other.descriptor
            && self.dim == other.dim
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_name_is_safe_in_a_path_and_a_metric_label() {
        for name in ["a", "tokyo-247", "0.floor_2"] {
            assert!(name.parse::<MapName>().is_ok(), "{name}");
        }
        for name in ["", ".", "..", "-a", "a/b", "A", "a b", "é", &"a".repeat(65)] {
            assert!(name.parse::<MapName>().is_err(), "{name}");
        }
    }
}
