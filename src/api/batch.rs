//! Responses to bulk uploads.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ImageField, Pose};

/// The result of a bulk upload.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchAnswer {
    /// Number of images that were stored.
    pub stored: usize,
    /// Number of images that were already present, including those that were updated.
    pub present: usize,
    /// Number of images that were already present and whose pose, time or tags the upload changed.
    #[serde(default)]
    pub updated: usize,
    /// Number of images that could not be stored, and of descriptions without an image.
    pub failed: usize,
    /// Number of files that were skipped because they are not images, such as links.
    #[serde(default)]
    pub skipped: usize,
    /// One result per image, in upload order. In an archive, an image and the file that describes it are one.
    pub results: Vec<BatchResult>,
}

/// The result for one image of a bulk upload.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchResult {
    /// Id of the image, if known; the name of a file that was skipped.
    #[schema(nullable)]
    pub id: Option<String>,
    /// Whether the image was stored.
    pub outcome: BatchOutcome,
    /// Pose that the image has now; null if it has none, or was not stored.
    #[serde(default)]
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// Fields of an image already present that the upload changed.
    #[serde(default)]
    pub changed: Vec<ImageField>,
    /// Why the image could not be stored, or the file was skipped; null if the image was stored.
    #[schema(nullable)]
    pub problem: Option<BatchProblem>,
    /// What the sender should know about the picture, such as damage in transit or a position that was not taken;
    /// usually empty.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// Whether an image of a bulk upload was stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum BatchOutcome {
    /// The image was stored.
    Stored,
    /// The image was already present. `changed` names the fields that the upload changed.
    Present,
    /// The image could not be stored.
    Failed,
    /// The file was skipped, because it is not an image.
    Skipped,
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
