//! Entries of the description cache, and the frames they belong to.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::{Descriptor, Digest, ImageId, MapName, StandIn, Usage};

/// A frame for which at least one pair has been described.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DescribedFrame {
    /// The query that posted the frame.
    pub query_id: Uuid,
    /// Digest of the frame's bytes.
    pub digest: Digest,
    /// Global descriptor of the frame.
    pub descriptor: Descriptor,
}

/// An earlier frame that is nearly identical to the current one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimilarFrame {
    /// Digest of the earlier frame's bytes.
    pub digest: Digest,
    /// How a job reports it.
    pub stand_in: StandIn,
}

/// Fill level of a description cache.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheLevels {
    /// Number of descriptions.
    pub entries: usize,
    /// Bytes of the descriptions and their keys.
    pub bytes: u64,
}

/// A description as the model wrote it, with its cost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CachedDescription {
    /// Similarities and differences of the pair.
    pub text: String,
    /// Cost of the call.
    pub usage: Usage,
    /// When the description was written.
    pub created_at: Timestamp,
    /// What the text is about; null for a description from an earlier version.
    #[serde(default)]
    #[schema(nullable)]
    pub about: Option<DescriptionSubject>,
}

/// The pair that a cached description is about, and who wrote it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DescriptionSubject {
    /// Name of the map.
    pub map: MapName,
    /// Id of the candidate's image.
    pub image_id: ImageId,
    /// The query that posted the frame.
    pub query_id: Uuid,
    /// Base URL of the model's server, without credentials.
    pub server: String,
    /// Name of the model.
    pub model: String,
}

/// A pair of matching regions in a frame and a reference image. Positions are fractions of the picture's
/// width and height, measured from the top left.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct PairRegion {
    /// Position in the frame.
    pub frame: [f32; 2],
    /// Position in the reference image.
    pub image: [f32; 2],
    /// Cosine similarity of the two regions, −1 to 1.
    pub similarity: f32,
}
