//! Reference images: their metadata and pages of them.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ExportedImage, Image, Map, Pose, PoseInput};

/// What a caller says about an image.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImageMeta {
    /// Its id; without one, the head of the digest of its bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Where it was taken from, in the frame of the map.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Pose>)]
    pub pose: Option<PoseInput>,
    /// When it was taken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub captured_at: Option<Timestamp>,
    /// Up to 32 words, each up to 64 characters.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<String>,
}

/// Some images, by id.
#[derive(Debug, Serialize, ToSchema)]
pub struct ImagePage {
    /// The images.
    pub images: Vec<Image>,
    /// Where the next page starts: `cursor=` of the next request. Null on the last page.
    pub next_cursor: Option<String>,
}

/// Some images of a map with their descriptors, by id.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct ExportPage {
    /// The map as it is stored. If `uid` or `revision` is another than on the page before, the map was
    /// made anew or reindexed, and the pages do not belong together.
    pub map: Map,
    /// The images.
    pub images: Vec<ExportedImage>,
    /// Where the next page starts: `cursor=` of the next request. Null on the last page.
    pub next_cursor: Option<String>,
}

/// An image that comes from another store; its bytes come beside.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImportedImage {
    /// The map that it was part of, as `export` gave it.
    pub map: Map,
    /// The image with its descriptor. Without one, the model makes one from the bytes.
    pub image: ExportedImage,
}
