//! Maps: what to set, and a map as callers see it.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{
    Calibration, CoordinateFrame, DescriptorKind, Digest, MapName, Precision, Scene,
};

/// What to set on a map. What is left out keeps its value, or its default in a new map.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MapChange {
    /// Indoor or outdoor (default).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scene: Option<Scene>,
    /// `gem` (default) or `cls`; once the map has images, only a reindex changes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<DescriptorKind>,
    /// `wgs84` (default) or `metric`; fixed once the map has images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<CoordinateFrame>,
    /// The model, one that is installed; in a new map by default the one that the server was
    /// started with. Once the map has images, only a reindex changes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// For people, up to 2,000 characters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
}

/// A map as callers see it.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct MapState {
    /// Its name.
    pub name: MapName,
    /// Indoor or outdoor.
    pub scene: Scene,
    /// Which descriptor it compares.
    pub descriptor: DescriptorKind,
    /// The frame of its poses.
    pub frame: CoordinateFrame,
    /// The model that makes its descriptors.
    pub model: String,
    /// The digest of that model's weights and of how they are fed and pooled.
    #[schema(value_type = String)]
    pub model_digest: Digest,
    /// The arithmetic that the model runs in; descriptors of another do not mix with them.
    pub precision: Precision,
    /// Numbers in a descriptor.
    pub dim: usize,
    /// Images in the map.
    pub images: usize,
    /// How it is searched: `exact`, `building` (a graph for part of it, the rest exactly), or
    /// `hnsw`.
    pub index: IndexKind,
    /// The reindex that goes on, or the last one since the server was started.
    #[serde(default)]
    #[schema(nullable)]
    pub reindex: Option<Reindex>,
    /// What confidence rests on; null until it is measured, a moment after images were added.
    #[serde(default)]
    #[schema(nullable)]
    pub calibration: Option<CalibrationState>,
    /// What a person wrote about it.
    pub description: Option<String>,
    /// When it was created.
    pub created_at: Timestamp,
}

/// How a map is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum IndexKind {
    /// Every descriptor is compared.
    Exact,
    /// A graph covers part of the map; the rest is compared.
    Building,
    /// A graph covers the whole map.
    Hnsw,
}

/// Which descriptors to make.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ReindexRequest {
    /// The model that makes them; by default the one that the map has, as it is installed now.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<String>,
    /// `gem` or `cls`; by default the one that the map has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<DescriptorKind>,
}

/// How far the last reindex of a map has come. It is forgotten when the server ends; the map has its
/// old descriptors until the reindex has succeeded.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Reindex {
    /// The model that makes the new descriptors.
    pub model: String,
    /// Which descriptors.
    pub descriptor: DescriptorKind,
    /// Whether it has ended, and how.
    pub state: ReindexState,
    /// Images that have their new descriptor.
    pub done: usize,
    /// Images of the map.
    pub total: usize,
    /// Why it failed.
    pub error: Option<String>,
    /// When it began.
    pub started_at: Timestamp,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
}

/// Whether a reindex has ended, and how.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ReindexState {
    /// It goes on; the old descriptors serve.
    Running,
    /// The new descriptors serve.
    Succeeded,
    /// It was given up; the old descriptors serve.
    Failed,
}

/// What confidence in a map rests on.
#[derive(Debug, Clone, Copy, Serialize, Deserialize, ToSchema)]
pub struct CalibrationState {
    /// Images that the map had when it was measured.
    pub images: usize,
    /// Images that were asked as if they were frames: the confidence of an answer at once is at most
    /// n / (n + 1).
    pub asked: usize,
    /// Of these, how many were refined too: the same for a refined answer. Where it is 0, the
    /// confidence of a refined answer rests on similarity.
    pub refined: usize,
}

impl From<&Calibration> for CalibrationState {
    fn from(known: &Calibration) -> Self {
        Self { images: known.images, asked: known.similarity.len(), refined: known.agreement.len() }
    }
}
