//! Text that was read in the images of a map.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{Digest, Image, ImageId, ImageTexts, TextLine};

/// How much of a map was read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct MapTexts {
    /// The reader, which new images are read by; null if none is installed. The counts are of what it read, and without
    /// a reader, of what any has read.
    #[schema(value_type = Option<String>, nullable)]
    pub reader: Option<Digest>,
    /// Number of images that were read.
    pub read: usize,
    /// Number of images that could not be read. They are not tried again by the same reader.
    pub failed: usize,
    /// Number of images that will be read; null without a reader.
    #[schema(nullable)]
    pub waiting: Option<usize>,
    /// Number of lines of text in the images that were read.
    pub lines: usize,
}

/// An image whose text matches what was searched for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ImageMatch {
    /// The id of the image.
    #[schema(value_type = String)]
    pub image_id: ImageId,
    /// How well it matches, from 0.5 to 1: 1 if a line is the text. It is no probability.
    pub score: f32,
    /// The lines that match.
    pub lines: Vec<TextLine>,
}

/// An image and the text that was read in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ImageState {
    /// The image.
    #[serde(flatten)]
    pub image: Image,
    /// What was read in it; null if it was not read yet, or no reader is installed.
    #[serde(default)]
    #[schema(nullable)]
    pub texts: Option<ImageTexts>,
}
