//! Maps: create, change, list, remove.

use jiff::Timestamp;
use uuid::Uuid;

use super::models::dimension;
use super::{SUPERSEDED, Service, ServiceError};
use whereabouts_api::{CalibrationState, ErrorKind, IndexKind, MapChange, MapState};
use whereabouts_core::{Map, MapName};
use whereabouts_store::{IndexState, StoreError};

impl Service {
    /// Creates a map or changes it; also says whether it is new.
    pub async fn put_map(
        &self,
        name: MapName,
        change: MapChange,
    ) -> Result<(MapState, bool), ServiceError> {
        if change.description.as_ref().is_some_and(|text| text.chars().count() > 2000) {
            return Err(ServiceError::unprocessable("the description exceeds 2,000 characters"));
        }
        let mut left = SUPERSEDED;
        loop {
            let known = self.maps.map(&name).await?;
            let wanted = self.changed(&name, &change, known).await?;
            match self.maps.put_map(wanted).await {
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
        let model = model.unwrap_or(self.models.default_model());
        let descriptor = change.descriptor.or(known.map(|map| map.descriptor)).unwrap_or_default();
        let (model_digest, precision, dim) = match known {
            // Those of its images, whatever is installed by now.
            Some(map)
                if (map.model.as_str(), map.descriptor) == (model, descriptor)
                    && self.maps.index_state(map).await?.images > 0 =>
            {
                (map.model_digest, map.precision, map.dim)
            }
            _ => {
                let extractor = self.installed_model(model).await?;
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
    pub async fn get_map(&self, name: &MapName) -> Result<MapState, ServiceError> {
        self.state_of(name).await
    }

    /// All maps, by name.
    pub async fn list_maps(&self) -> Result<Vec<MapState>, ServiceError> {
        let mut states = Vec::new();
        for map in self.maps.maps().await? {
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
    pub async fn delete_map(&self, name: &MapName) -> Result<(), ServiceError> {
        let map = self.known_map(name).await?;
        match self.maps.delete_map(name).await? {
            true => {
                self.reindexes.forget(map.uid);
                Ok(())
            }
            false => Err(no_map(name)),
        }
    }

    pub(super) async fn known_map(&self, name: &MapName) -> Result<Map, ServiceError> {
        self.maps.map(name).await?.ok_or_else(|| no_map(name))
    }

    pub(super) async fn state_of(&self, name: &MapName) -> Result<MapState, ServiceError> {
        let reindex = self.reindexes.of(self.known_map(name).await?.uid);
        // Looked up after that: when a reindex has succeeded, the map shows it.
        let map = self.known_map(name).await?;
        let IndexState { images, graph, behind, .. } = self.maps.index_state(&map).await?;
        let calibration = self.maps.calibration(&map).await?;
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
