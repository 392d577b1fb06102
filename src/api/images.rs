//! Reference images: metadata and pages.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ExportedImage, Image, Map, Pose, PoseInput};

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
    /// When the picture was taken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub captured_at: Option<Timestamp>,
    /// Up to 32 tags of up to 64 characters each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<String>,
}

/// The response to an upload.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct UploadedImage {
    /// The stored image.
    #[serde(flatten)]
    pub image: Image,
    /// What the sender should know about the picture, such as damage in transit; usually empty.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// A page of images, sorted by id.
#[derive(Debug, Serialize, ToSchema)]
pub struct ImagePage {
    /// Images on this page.
    pub images: Vec<Image>,
    /// `cursor=` of the request for the next page; null on the last page.
    pub next_cursor: Option<String>,
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

/// An image to be imported; its bytes are sent as a separate part.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImportedImage {
    /// The map that the image was exported from, as returned by `export`.
    pub map: Map,
    /// The image with its descriptor. Without a descriptor, the model computes one from the bytes.
    pub image: ExportedImage,
}
