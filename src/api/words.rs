//! Localization from words alone.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ImageId, MapName, Pose, TextLine};

/// A place described in words, in place of a frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct WordsRequest {
    /// What is there, above all what signs say: at most 500 characters, in any language.
    #[schema(example = "opposite the pharmacy, KAWA COFFEE is on its left")]
    pub text: String,
}

/// Where the place that was described probably is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct WordsAnswer {
    /// Map that was searched.
    pub map: MapName,
    /// The images that fit the description best, best first; empty if none shows any of the signs.
    pub candidates: Vec<WordsCandidate>,
    /// The most likely place; null if no image shows any of the signs.
    #[schema(nullable)]
    pub estimate: Option<WordsEstimate>,
    /// Why the place is not known, and what would help; null if it is.
    #[schema(nullable)]
    pub reason: Option<String>,
    /// The signs that the description names, in its order.
    pub signs: Vec<NamedSign>,
    /// How many images of the map are not read, and may show any sign.
    pub unread: usize,
    /// What the sender should know about the description; usually empty.
    pub warnings: Vec<String>,
    /// Duration of the search.
    pub timing_ms: WordsTimingMs,
}

/// An image that fits a description.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct WordsCandidate {
    /// Rank; 1 is the most likely.
    pub rank: usize,
    /// Id of the image.
    #[schema(value_type = String)]
    pub image_id: ImageId,
    /// Pose of the image, if known.
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// Probability, 0 to 1, that this image shows the place.
    pub probability: f64,
    /// The signs of the description that were read in it.
    pub signs: Vec<SeenSign>,
}

/// A sign of a description that was read in an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SeenSign {
    /// What the description says.
    pub text: String,
    /// What was read, and where in the image.
    pub lines: Vec<TextLine>,
}

/// The most likely place of a description.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct WordsEstimate {
    /// Image that shows the place.
    #[schema(value_type = String)]
    pub image_id: ImageId,
    /// Pose of that image, if known.
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// Probability, 0 to 1, that the place is that of the image: the sum over all images that show the same place by their
    /// poses or their order.
    pub probability: f64,
    /// Whether the probability reaches the configured threshold (`localize.known_confidence`).
    pub known: bool,
}

/// A sign that a description names.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct NamedSign {
    /// What the description says.
    pub text: String,
    /// Whether it is a name by how it is written: in quotation marks, in capitals, or with a capital letter. A name that
    /// was read nowhere is evidence that the place is not in the map.
    pub is_name: bool,
    /// Number of images in which it was read.
    pub images: usize,
}

/// Duration of a search.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct WordsTimingMs {
    /// Total until the response, including queueing.
    pub total: f64,
}
