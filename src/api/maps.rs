//! Maps: changes, state and reindexing.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::MapTexts;
use whereabouts_core::{
    Calibration, CoordinateFrame, DescriptorKind, Digest, MapName, Precision, RefinerKind, Scene,
};

/// A change of a map. Omitted fields keep their value, or get their default in a new map.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MapChange {
    /// `indoor` or `outdoor` (default).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scene: Option<Scene>,
    /// A kind of descriptor that the model declares, such as `gem`, `cls` or `vlad`; by default the model's default.
    /// Once the map has images, only a reindex changes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<DescriptorKind>,
    /// `wgs84` (default) or `metric`. Fixed while an image of the map has a pose.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<CoordinateFrame>,
    /// Name of an installed model. A new map gets the server's default model if omitted. Once the map has
    /// images, only a reindex changes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// The refiner of the map's jobs, of those that the server allows (`refine.refiner`, `refine.allowed`): `local`,
    /// `cascade`, `mllm`, or `default` (the server's). Requests may choose one that costs no more.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refiner: Option<MapRefiner>,
    /// Free text for people, up to 2,000 characters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
}

/// The refiner that a map is set to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum MapRefiner {
    /// The server's.
    Default,
    /// `local`.
    Local,
    /// `cascade`.
    Cascade,
    /// `mllm`.
    Mllm,
}

impl MapRefiner {
    /// Returns the refiner; `None` for the server's.
    pub fn kind(self) -> Option<RefinerKind> {
        match self {
            Self::Default => None,
            Self::Local => Some(RefinerKind::Local),
            Self::Cascade => Some(RefinerKind::Cascade),
            Self::Mllm => Some(RefinerKind::Mllm),
        }
    }
}

/// The state of a map.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct MapState {
    /// Name of the map.
    pub name: MapName,
    /// Indoor or outdoor.
    pub scene: Scene,
    /// Kind of descriptor that is compared.
    pub descriptor: DescriptorKind,
    /// Coordinate frame of the poses.
    pub frame: CoordinateFrame,
    /// Model that computes the descriptors.
    pub model: String,
    /// Digest of the model's weights, preprocessing and pooling to this kind of descriptor.
    #[schema(value_type = String)]
    pub model_digest: Digest,
    /// Precision at which the model runs. Descriptors of different precisions are not comparable.
    pub precision: Precision,
    /// Dimension of the descriptors.
    pub dim: usize,
    /// The vocabulary of the descriptors; null if this kind has none.
    #[serde(default)]
    #[schema(nullable)]
    pub vocabulary: Option<VocabularyState>,
    /// Number of images in the map.
    pub images: usize,
    /// How the map is searched: `exact`, `building` (a graph covers part of the map, the rest is searched
    /// exactly), or `hnsw`.
    pub index: IndexKind,
    /// The running reindex, or the last one since the server started.
    #[serde(default)]
    #[schema(nullable)]
    pub reindex: Option<Reindex>,
    /// Calibration of confidence; null until it has run, shortly after images were added.
    #[serde(default)]
    #[schema(nullable)]
    pub calibration: Option<CalibrationState>,
    /// How much of the text in the images was read; null if none was and no reader is installed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(nullable)]
    pub texts: Option<MapTexts>,
    /// The refiner that the map is set to; null for the server's.
    #[serde(default)]
    #[schema(nullable)]
    pub refiner: Option<RefinerKind>,
    /// Free text for people.
    pub description: Option<String>,
    /// When the map was created.
    pub created_at: Timestamp,
}

/// How a map is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum IndexKind {
    /// Exact search over every descriptor.
    Exact,
    /// A graph covers part of the map; the rest is searched exactly.
    Building,
    /// A graph covers the whole map.
    Hnsw,
}

/// A request to recompute the descriptors of a map.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ReindexRequest {
    /// Model that computes the new descriptors; by default the map's model as currently installed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// A kind of descriptor that the model declares; by default the map's kind, or the model's default if the model
    /// does not have that kind.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<DescriptorKind>,
    /// The vocabulary of a descriptor like `vlad`. `own` fits one on the images of the map, whatever is measured;
    /// `shipped` takes that of the model, and the map keeps it. By default that of the model, until the server finds one
    /// of the map's own to be better (`vocabulary.own`).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vocabulary: Option<VocabularyChoice>,
}

/// Which vocabulary a descriptor uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum VocabularyChoice {
    /// That of the model.
    Shipped,
    /// One that was fitted on the images of the map.
    Own,
}

/// The vocabulary of a map whose descriptors have one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct VocabularyState {
    /// `shipped` with the model, or the map's `own`.
    pub source: VocabularyChoice,
    /// SHA-256 of the vocabulary.
    #[schema(value_type = Option<String>)]
    pub digest: Option<Digest>,
    /// When an own vocabulary was fitted.
    pub fitted_at: Option<Timestamp>,
    /// Number of images that an own vocabulary was fitted on.
    pub images: Option<usize>,
    /// Why the map has the vocabulary of the model; null if it has its own, or if one may be fitted.
    pub reason: Option<String>,
}

/// The progress of the last reindex of a map. It is lost when the server restarts. The map keeps its old descriptors
/// until the reindex has succeeded.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Reindex {
    /// Model that computes the new descriptors.
    pub model: String,
    /// Kind of the new descriptors.
    pub descriptor: DescriptorKind,
    /// State of the reindex.
    pub state: ReindexState,
    /// Number of images that have their new descriptor.
    pub done: usize,
    /// Number of images in the map.
    pub total: usize,
    /// Why the reindex failed.
    pub error: Option<String>,
    /// When the reindex started.
    pub started_at: Timestamp,
    /// When the reindex finished.
    pub finished_at: Option<Timestamp>,
}

/// The state of a reindex.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ReindexState {
    /// Running; the old descriptors are in use.
    Running,
    /// Succeeded; the new descriptors are in use.
    Succeeded,
    /// Failed; the old descriptors are in use.
    Failed,
}

/// The calibration of confidence in a map.
#[derive(Debug, Clone, Copy, Serialize, Deserialize, ToSchema)]
pub struct CalibrationState {
    /// Number of images in the map when it was calibrated.
    pub images: usize,
    /// Number n of images used as queries. The confidence of an unrefined estimate is at most 0.1^(1/n): 22 images are
    /// the fewest for 0.9.
    pub asked: usize,
    /// Number n of these queries that were also refined. The confidence of a refined estimate is at most n / (n + 1). If
    /// it is 0, the confidence of a refined estimate is based on similarity.
    pub refined: usize,
    /// Number of these queries about which the model was asked (`confidence.model_calls`). If it is 0, the model counts
    /// as one that is certain of every wrong image.
    #[serde(default)]
    pub model_asked: usize,
}

impl From<&Calibration> for CalibrationState {
    fn from(calibration: &Calibration) -> Self {
        Self {
            images: calibration.images,
            asked: calibration.similarity.len(),
            refined: calibration.agreement.len(),
            model_asked: calibration.model_asked,
        }
    }
}
