//! Maps: create, change, list, remove.

use std::sync::Arc;

use jiff::Timestamp;
use uuid::Uuid;

use super::models::dimension;
use super::{Imaging, Reindexes, SUPERSEDED, ServiceError};
use whereabouts_api::{CalibrationState, ErrorKind, IndexKind, MapChange, MapState};
use whereabouts_core::{Map, MapName};
use whereabouts_store::{IndexState, MapStore, StoreError};

/// Maps: create, change, list, remove. Clones share the store.
#[derive(Clone)]
pub struct Maps {
    /// Maps, images, descriptors.
    pub store: Arc<dyn MapStore>,
    /// Models and what runs them.
    pub imaging: Imaging,
    /// The last reindex of each map.
    pub reindexes: Arc<Reindexes>,
}

impl Maps {
    /// Creates a map or changes it; also says whether it is new.
    pub async fn put(
        &self,
        name: MapName,
        change: MapChange,
    ) -> Result<(MapState, bool), ServiceError> {
        if change.description.as_ref().is_some_and(|text| text.chars().count() > 2000) {
            return Err(ServiceError::unprocessable("the description exceeds 2,000 characters"));
        }
        let mut left = SUPERSEDED;
        loop {
            let known = self.store.map(&name).await?;
            let wanted = self.changed(&name, &change, known).await?;
            match self.store.put_map(wanted).await {
                // It was reindexed since it was looked up.
                Err(StoreError::Superseded(_)) if left > 0 => left -= 1,
                put => {
                    let (map, new) = put?;
                    return Ok((self.state_of(&map.name).await?, new));
                }
            }
        }
    }

    /// The map as a change wants it.
    async fn changed(
        &self,
        name: &MapName,
        change: &MapChange,
        known: Option<Map>,
    ) -> Result<Map, ServiceError> {
        let known = known.as_ref();
        let model = change.model.as_deref().or(known.map(|map| map.model.as_str()));
        let model = model.unwrap_or(self.imaging.models.default_model());
        let descriptor = change.descriptor.or(known.map(|map| map.descriptor)).unwrap_or_default();
        let (model_digest, precision, dim) = match known {
            // Those of its images, whatever is installed by now.
            Some(map)
                if (map.model.as_str(), map.descriptor) == (model, descriptor)
                    && self.store.index_state(map).await?.images > 0 =>
            {
                (map.model_digest, map.precision, map.dim)
            }
            _ => {
                let extractor = self.imaging.installed_model(model).await?;
                let dim = dimension(extractor.manifest(), descriptor)?;
                (extractor.digest(), extractor.execution().precision, dim)
            }
        };
        Ok(Map {
            uid: Uuid::now_v7(),
            name: name.clone(),
            scene: change.scene.or(known.map(|map| map.scene)).unwrap_or_default(),
            descriptor,
            frame: change.frame.or(known.map(|map| map.frame)).unwrap_or_default(),
            model: model.to_owned(),
            model_digest,
            precision,
            dim,
            revision: known.map_or(0, |map| map.revision),
            description: change
                .description
                .clone()
                .or_else(|| known.and_then(|map| map.description.clone())),
            created_at: Timestamp::now(),
        })
    }

    /// One map.
    pub async fn get(&self, name: &MapName) -> Result<MapState, ServiceError> {
        self.state_of(name).await
    }

    /// All maps, by name.
    pub async fn list(&self) -> Result<Vec<MapState>, ServiceError> {
        let mut states = Vec::new();
        for map in self.store.maps().await? {
            match self.state_of(&map.name).await {
                Ok(state) => states.push(state),
                // Removed since it was listed.
                Err(error) if error.kind == ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        Ok(states)
    }

    /// Removes a map with all its images.
    pub async fn delete(&self, name: &MapName) -> Result<(), ServiceError> {
        let map = self.known(name).await?;
        match self.store.delete_map(name).await? {
            true => {
                self.reindexes.forget(map.uid);
                Ok(())
            }
            false => Err(no_map(name)),
        }
    }

    pub(crate) async fn known(&self, name: &MapName) -> Result<Map, ServiceError> {
        self.store.map(name).await?.ok_or_else(|| no_map(name))
    }

    pub(crate) async fn state_of(&self, name: &MapName) -> Result<MapState, ServiceError> {
        let reindex = self.reindexes.of(self.known(name).await?.uid);
        // Looked up after that: when a reindex has succeeded, the map shows it.
        let map = self.known(name).await?;
        let IndexState { images, graph, behind, .. } = self.store.index_state(&map).await?;
        let calibration = self.store.calibration(&map).await?;
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
            calibration: calibration.as_deref().map(CalibrationState::from),
            description: map.description,
            reindex,
            created_at: map.created_at,
        })
    }
}

fn no_map(name: &MapName) -> ServiceError {
    ServiceError::not_found(format!(
        "there is no map {name}; create it with PUT /maps/{name}, or list them with GET /maps"
    ))
}
