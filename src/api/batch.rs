//! Responses to bulk uploads.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// The result of a bulk upload.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchAnswer {
    /// Number of images that were stored.
    pub stored: usize,
    /// Number of images that were already present.
    pub present: usize,
    /// Number of images that could not be stored.
    pub failed: usize,
    /// One result per image, in upload order.
    pub results: Vec<BatchResult>,
}

/// The result for one image of a bulk upload.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchResult {
    /// Id of the image, if known.
    #[schema(nullable)]
    pub id: Option<String>,
    /// Whether the image was stored.
    pub outcome: BatchOutcome,
    /// Why the image could not be stored; null if it was.
    #[schema(nullable)]
    pub problem: Option<BatchProblem>,
    /// What the sender should know about the picture, such as damage in transit; usually empty.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// Whether an image of a bulk upload was stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum BatchOutcome {
    /// The image was stored.
    Stored,
    /// The image was already present.
    Present,
    /// The image could not be stored.
    Failed,
}

/// Why an image could not be stored.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchProblem {
    /// Kind of the problem: the last segment of its `type`.
    pub kind: String,
    /// What happened and what to do next.
    pub detail: String,
    /// Seconds after which a retry may succeed, if known.
    #[schema(nullable)]
    pub retry_after_s: Option<f64>,
}
