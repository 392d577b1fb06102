//! Maps: create, change, list and delete. Their images are for `images`, new descriptors for `reindex`.

use std::sync::Arc;

use jiff::Timestamp;
use uuid::Uuid;

use super::fitting::obstacle;
use super::models::{descriptor_of, kind_of};
use super::{
    AllowedRefiners, Imaging, Reading, Reindexes, SUPERSEDED_RETRIES, ServiceError,
    VocabularySettings,
};
use whereabouts_api::{
    CalibrationState, ErrorKind, IndexKind, MapChange, MapRefiner, MapState, VocabularyChoice,
    VocabularyState,
};
use whereabouts_core::{Map, MapName};
use whereabouts_store::{IndexState, MapStore, StoreError};

/// Maps: create, change, list and delete. Clones share the store.
#[derive(Clone)]
pub struct Maps {
    /// Maps, images and descriptors.
    pub store: Arc<dyn MapStore>,
    /// Models and the threads that run them.
    pub imaging: Imaging,
    /// The state of the last reindex of each map.
    pub reindexes: Arc<Reindexes>,
    /// When maps get a vocabulary of their own.
    pub vocabulary: VocabularySettings,
    /// The refiners to which a map may be set.
    pub refiners: AllowedRefiners,
    /// What knows how much of a map was read.
    pub reading: Arc<Reading>,
}

impl Maps {
    /// Creates or changes a map. Returns its state, and whether it is new.
    pub async fn put(
        &self,
        name: MapName,
        change: MapChange,
    ) -> Result<(MapState, bool), ServiceError> {
        if change.description.as_ref().is_some_and(|text| text.chars().count() > 2000) {
            return Err(ServiceError::unprocessable("the description exceeds 2,000 characters"));
        }
        if let Some(kind) = change.refiner.and_then(MapRefiner::kind) {
            self.refiners.check(kind)?;
        }
        let mut retries = SUPERSEDED_RETRIES;
        loop {
            let known = self.store.map(&name).await?;
            let map = self.changed(&name, &change, known).await?;
            match self.store.put_map(map).await {
                // It was reindexed since it was read.
                Err(StoreError::Superseded(_)) if retries > 0 => retries -= 1,
                put => {
                    let (map, new) = put?;
                    return Ok((self.state_of(&map.name).await?, new));
                }
            }
        }
    }

    /// Applies a change to a map, or to the defaults if the map is new.
    async fn changed(
        &self,
        name: &MapName,
        change: &MapChange,
        known: Option<Map>,
    ) -> Result<Map, ServiceError> {
        let known = known.as_ref();
        let model = change.model.as_deref().or(known.map(|map| map.model.as_str()));
        let model = model.unwrap_or(self.imaging.models.default_model());
        let unchanged = known.filter(|map| {
            map.model == model && change.descriptor.is_none_or(|kind| kind == map.descriptor)
        });
        let mut vocabulary = None;
        let (descriptor, model_digest, precision, dim) = match unchanged {
            // The images keep the model that made their descriptors, whatever is installed now.
            Some(map) if self.store.index_state(map).await?.images > 0 => {
                vocabulary = map.vocabulary;
                (map.descriptor, map.model_digest, map.precision, map.dim)
            }
            _ => {
                let extractor = self.imaging.installed_model(model).await?;
                let current = known.map(|map| map.descriptor);
                let kind = kind_of(extractor.manifest(), change.descriptor, current)?;
                let (digest, dim) = descriptor_of(&extractor, kind)?;
                (kind, digest, extractor.execution().precision, dim)
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
            refiner: match change.refiner {
                Some(refiner) => refiner.kind(),
                None => known.and_then(|map| map.refiner),
            },
            vocabulary,
            keeps_shipped: known.is_some_and(|map| map.keeps_shipped),
            description: change
                .description
                .clone()
                .or_else(|| known.and_then(|map| map.description.clone())),
            created_at: Timestamp::now(),
        })
    }

    /// Returns the state of a map.
    pub async fn get(&self, name: &MapName) -> Result<MapState, ServiceError> {
        self.state_of(name).await
    }

    /// Returns the states of all maps, by name.
    pub async fn list(&self) -> Result<Vec<MapState>, ServiceError> {
        let mut states = Vec::new();
        for map in self.store.maps().await? {
            match self.state_of(&map.name).await {
                Ok(state) => states.push(state),
                // Deleted since it was listed.
                Err(error) if error.kind == ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        Ok(states)
    }

    /// Deletes a map with all its images.
    pub async fn delete(&self, name: &MapName) -> Result<(), ServiceError> {
        let map = self.find(name).await?;
        match self.store.delete_map(name).await? {
            true => {
                self.reindexes.forget(map.uid);
                Ok(())
            }
            false => Err(no_map(name)),
        }
    }

    /// Returns a map.
    pub async fn find(&self, name: &MapName) -> Result<Map, ServiceError> {
        self.store.map(name).await?.ok_or_else(|| no_map(name))
    }

    pub(crate) async fn state_of(&self, name: &MapName) -> Result<MapState, ServiceError> {
        let reindex = self.reindexes.get(self.find(name).await?.uid);
        // Read again after the reindex state: if that says succeeded, the map has the new model.
        let map = self.find(name).await?;
        let IndexState { images, graph, behind, .. } = self.store.index_state(&map).await?;
        let calibration = self.store.calibration(&map).await?;
        let vocabulary = self.vocabulary_of(&map, images).await;
        let texts = self.reading.state_of(&map, images).await?;
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
            vocabulary,
            images,
            index,
            calibration: calibration.as_deref().map(CalibrationState::from),
            texts,
            refiner: map.refiner,
            description: map.description,
            reindex,
            created_at: map.created_at,
        })
    }
}

impl Maps {
    /// Describes the vocabulary of a map; `None` if its descriptors have none.
    async fn vocabulary_of(&self, map: &Map, images: usize) -> Option<VocabularyState> {
        if let Some(own) = map.vocabulary {
            return Some(VocabularyState {
                source: VocabularyChoice::Own,
                digest: Some(own.digest),
                fitted_at: Some(own.fitted_at),
                images: Some(own.images),
                reason: None,
            });
        }
        if !map.descriptor.may_have_vocabulary() {
            return None;
        }
        let manifest = self.imaging.manifest(&map.model).await.ok()?;
        let digest = manifest.vocabulary(map.descriptor)?;
        let declined = || self.reindexes.declined(map).map(|declined| declined.why);
        let reason = match manifest.may_have_own(map.descriptor) {
            true => obstacle(map, images, &self.vocabulary).or_else(declined),
            false => Some("the model's descriptor has no projection that could be fitted".into()),
        };
        let source = VocabularyChoice::Shipped;
        Some(VocabularyState { source, digest, fitted_at: None, images: None, reason })
    }
}

fn no_map(name: &MapName) -> ServiceError {
    ServiceError::not_found(format!(
        "there is no map {name}; create it with PUT /maps/{name}, or list them with GET /maps"
    ))
}
