//! Descriptions of pairs as the description cache keeps them, and the frames they belong to.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::{Descriptor, Digest, StandIn, Usage};

/// A frame whose pairs were described.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DescribedFrame {
    /// Its query.
    pub query_id: Uuid,
    /// Its bytes.
    pub digest: Digest,
    /// Its descriptor.
    pub descriptor: Descriptor,
}

/// An earlier frame that resembles another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SimilarFrame {
    /// Its bytes.
    pub digest: Digest,
    /// What a job says of it.
    pub stand_in: StandIn,
}

/// How full a cache of descriptions is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheLevels {
    /// Descriptions.
    pub entries: usize,
    /// Their bytes, keys included.
    pub bytes: u64,
}

/// A description as it was bought.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CachedDescription {
    /// What agrees and what differs, in words.
    pub text: String,
    /// What the call cost.
    pub usage: Usage,
    /// When it was made.
    pub created_at: Timestamp,
}

/// A region of a frame, and the one that it agrees with in a reference image. Positions are in fractions of
/// the pictures' width and height, from the top left.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, ToSchema)]
pub struct PairRegion {
    /// In the frame.
    pub frame: [f32; 2],
    /// In the image.
    pub image: [f32; 2],
    /// Cosine similarity of the two, −1 to 1.
    pub similarity: f32,
}
