//! Maps: create, change, list, remove.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use super::{ErrorKind, Service, ServiceError};
use crate::domain::{DescriptorKind, Digest, Frame, Map, MapName, Precision, Scene};
use crate::store::IndexState;

/// What to set on a map. What is left out keeps its value, or its default in a new map.
#[derive(Debug, Clone, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MapChange {
    /// Indoor or outdoor (default).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scene: Option<Scene>,
    /// `gem` (default) or `cls`; fixed once the map has images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub descriptor: Option<DescriptorKind>,
    /// `wgs84` (default) or `metric`; fixed once the map has images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<Frame>,
    /// The model; it must be the one that the server runs. Fixed once the map has images.
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
    pub frame: Frame,
    /// The model that makes its descriptors.
    pub model: String,
    /// The digest of that model's ONNX file.
    #[schema(value_type = String)]
    pub model_digest: Digest,
    /// The arithmetic that the model runs in; descriptors of another are refused.
    pub precision: Precision,
    /// Numbers in a descriptor.
    pub dim: usize,
    /// Images in the map.
    pub images: usize,
    /// How it is searched: `exact`, `building` (a graph for part of it, the rest exactly), or
    /// `hnsw`.
    pub index: IndexKind,
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

impl Service {
    /// Creates a map or changes it; also says whether it is new.
    pub async fn put_map(
        &self,
        name: MapName,
        change: MapChange,
    ) -> Result<(MapState, bool), ServiceError> {
        let manifest = self.extractor.manifest();
        if let Some(model) = &change.model
            && *model != manifest.name
        {
            return Err(ServiceError::unprocessable(format!(
                "this server runs the model {:?}, not {model:?}; start one with --model {model}",
                manifest.name
            )));
        }
        if change.description.as_ref().is_some_and(|text| text.chars().count() > 2000) {
            return Err(ServiceError::unprocessable("the description exceeds 2,000 characters"));
        }
        let known = self.maps.map(&name).await?;
        let known = known.as_ref();
        let descriptor = change.descriptor.or(known.map(|map| map.descriptor)).unwrap_or_default();
        let dim = manifest.dimension(descriptor).ok_or_else(|| {
            ServiceError::unprocessable(format!(
                "the model {:?} has no [CLS] token; use \"descriptor\": \"gem\"",
                manifest.name
            ))
        })?;
        let map = Map {
            uid: Uuid::now_v7(),
            name,
            scene: change.scene.or(known.map(|map| map.scene)).unwrap_or_default(),
            descriptor,
            frame: change.frame.or(known.map(|map| map.frame)).unwrap_or_default(),
            model: manifest.name.clone(),
            model_digest: self.extractor.digest(),
            precision: self.extractor.execution().precision,
            dim,
            description: change
                .description
                .or_else(|| known.and_then(|map| map.description.clone())),
            created_at: Timestamp::now(),
        };
        let (map, new) = self.maps.put_map(map).await?;
        Ok((self.state_of(map).await?, new))
    }

    /// One map.
    pub async fn get_map(&self, name: &MapName) -> Result<MapState, ServiceError> {
        self.state_of(self.known_map(name).await?).await
    }

    /// All maps, by name.
    pub async fn list_maps(&self) -> Result<Vec<MapState>, ServiceError> {
        let mut states = Vec::new();
        for map in self.maps.maps().await? {
            match self.state_of(map).await {
                Ok(state) => states.push(state),
                // Removed since it was listed.
                Err(error) if error.kind == ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        Ok(states)
    }

    /// Removes a map with all its images.
    pub async fn delete_map(&self, name: &MapName) -> Result<(), ServiceError> {
        match self.maps.delete_map(name).await? {
            true => Ok(()),
            false => Err(no_map(name)),
        }
    }

    pub(super) async fn known_map(&self, name: &MapName) -> Result<Map, ServiceError> {
        self.maps.map(name).await?.ok_or_else(|| no_map(name))
    }

    /// The map, if its descriptors are of the model that is loaded.
    pub(super) async fn searchable_map(&self, name: &MapName) -> Result<Map, ServiceError> {
        let map = self.known_map(name).await?;
        let precision = self.extractor.execution().precision;
        if map.model_digest == self.extractor.digest() {
            if map.precision == precision {
                return Ok(map);
            }
            let detail = format!(
                "the map {name} was indexed at {} precision, but the server runs the model at \
                 {precision} precision; start it with model.precision = \"{}\", or index the images \
                 into a new map",
                map.precision, map.precision
            );
            return Err(ServiceError::new(ErrorKind::Conflict, detail));
        }
        Err(ServiceError::new(
            ErrorKind::Conflict,
            format!(
                "the map {name} was indexed with the model {:?} ({}), but the server runs {:?} \
                 ({}); start it with --model {}, or index the images into a new map",
                map.model,
                map.model_digest,
                self.extractor.manifest().name,
                self.extractor.digest(),
                map.model
            ),
        ))
    }

    async fn state_of(&self, map: Map) -> Result<MapState, ServiceError> {
        let IndexState { images, graph, behind } = self.maps.index_state(&map).await?;
        let index = match (graph, behind) {
            (false, _) => IndexKind::Exact,
            (true, true) => IndexKind::Building,
            (true, false) => IndexKind::Hnsw,
        };
        Ok(MapState {
            name: map.name,
            scene: map.scene,
            descriptor: map.descriptor,
            frame: map.frame,
            model: map.model,
            model_digest: map.model_digest,
            precision: map.precision,
            dim: map.dim,
            images,
            index,
            description: map.description,
            created_at: map.created_at,
        })
    }
}

fn no_map(name: &MapName) -> ServiceError {
    ServiceError::not_found(format!(
        "there is no map {name}; create it with PUT /maps/{name}, or list them with GET /maps"
    ))
}
