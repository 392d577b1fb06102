//! Text that was read in the images of a map.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::Digest;

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
