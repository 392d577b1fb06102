//! Reference images: metadata and pages.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Deserializer, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{
    ExportedImage, Image, ImageField, Map, Pose, PoseInput, PosePatch, Recording, moment,
};

use super::ImageMatch;

/// Metadata of an image to be added.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImageMeta {
    /// Id of the image; by default, derived from the digest of its bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Pose of the camera, in the coordinate frame of the map.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Pose>)]
    pub pose: Option<PoseInput>,
    /// When the picture was taken: RFC 3339 with an offset, or seconds since 1970.
    #[serde(
        default,
        deserialize_with = "moment::optional",
        skip_serializing_if = "Option::is_none"
    )]
    pub captured_at: Option<Timestamp>,
    /// Up to 32 tags of up to 64 characters each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<String>,
    /// Place of the image in a recording; by default, its place in the request, or the order of arrival. Tracks follow
    /// the images of a recording in its order. It is stored with a new image, and cannot be changed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<Recording>,
}

/// A change of an image (JSON merge patch, RFC 7396): an omitted field keeps its value, and null removes it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImagePatch {
    /// Changes of the pose: `{"lat": 1.5}` changes only the latitude.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<PosePatch>, nullable)]
    pub pose: Option<Option<PosePatch>>,
    /// When the picture was taken: RFC 3339 with an offset, or seconds since 1970.
    #[serde(default, deserialize_with = "moment::given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>, format = DateTime, nullable)]
    pub captured_at: Option<Option<Timestamp>>,
    /// The new tags, which replace all old ones: up to 32 of up to 64 characters each.
    #[serde(default, deserialize_with = "given", skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Vec<String>>, nullable)]
    pub tags: Option<Option<Vec<String>>>,
}

/// Distinguishes null from an omitted field.
fn given<'de, T, D>(value: D) -> Result<Option<Option<T>>, D::Error>
where
    T: Deserialize<'de>,
    D: Deserializer<'de>,
{
    Option::deserialize(value).map(Some)
}

/// An image as it is stored now, and what the request changed of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ImageAnswer {
    /// The image as it is stored now.
    #[serde(flatten)]
    pub image: Image,
    /// Fields of an image stored before that the request changed: `pose`, `captured_at`, `tags`. Empty for an image
    /// that is new or stayed as it was.
    #[serde(default)]
    pub changed: Vec<ImageField>,
    /// What the sender should know about the picture, such as a position that was not taken; usually empty.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// A page of images, sorted by id; in a search for text, the best match first.
#[derive(Debug, Serialize, ToSchema)]
pub struct ImagePage {
    /// Images on this page.
    pub images: Vec<Image>,
    /// `cursor=` of the request for the next page; null on the last page.
    pub next_cursor: Option<String>,
    /// What matches in each of the images, in the same order; only in a search for text.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable)]
    pub matches: Option<Vec<ImageMatch>>,
    /// How many images of the map are not read yet, and may match later; only in a search for text.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable)]
    pub unread: Option<usize>,
}

/// A page of images with their descriptors, sorted by id.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct ExportPage {
    /// The record of the map. If `uid` or `revision` differs from the previous page, the map was recreated or
    /// reindexed in between, and the pages are inconsistent.
    pub map: Map,
    /// Images on this page.
    pub images: Vec<ExportedImage>,
    /// `cursor=` of the request for the next page; null on the last page.
    pub next_cursor: Option<String>,
}

/// A map to be imported.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct ImportedMap {
    /// The map that was exported, as returned by `export`.
    #[serde(flatten)]
    pub map: Map,
    /// The bytes of `GET /maps/{map}/vocabulary` in base64, if `map` has a vocabulary of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub vocabulary_data: Option<VocabularyData>,
}

/// The bytes of a vocabulary, serialized in base64.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct VocabularyData(pub Bytes);

impl From<Bytes> for VocabularyData {
    fn from(bytes: Bytes) -> Self {
        Self(bytes)
    }
}

impl From<VocabularyData> for String {
    fn from(data: VocabularyData) -> Self {
        STANDARD.encode(data.0)
    }
}

impl TryFrom<String> for VocabularyData {
    type Error = base64::DecodeError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        STANDARD.decode(text).map(|bytes| Self(bytes.into()))
    }
}

/// An image to be imported; its bytes are sent as a separate part.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImportedImage {
    /// The map that the image was exported from, as returned by `export`.
    pub map: Map,
    /// The image with its descriptor. Without a descriptor, the model computes one from the bytes.
    pub image: ExportedImage,
}
