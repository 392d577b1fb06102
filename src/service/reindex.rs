//! New descriptors for a whole map, by another model, while the old ones serve.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::{Mutex, MutexGuard};
use tokio::sync::Semaphore;
use uuid::Uuid;

use super::models::dimension;
use super::{Service, ServiceError};
use whereabouts_api::{ErrorKind, MapState, Reindex, ReindexRequest, ReindexState};
use whereabouts_core::{Descriptor, DescriptorKind, Image, Map, MapName};
use whereabouts_store::Draft;
use whereabouts_vision::{AdmissionRequest, Extractor, FeatureSet};

/// Images that are looked up at a time.
const PAGE: usize = 256;

/// The pause while there is none.
const PAUSE: Duration = Duration::from_millis(50);

/// The last reindex of every map.
#[derive(Debug)]
pub struct Reindexes {
    /// By the uid of the map.
    known: Mutex<BTreeMap<Uuid, Reindex>>,
    /// One image of all maps at a time: robots wait for the same sessions.
    turn: Semaphore,
}

impl Default for Reindexes {
    fn default() -> Self {
        Self { known: Mutex::default(), turn: Semaphore::new(1) }
    }
}

impl Reindexes {
    pub(super) fn of(&self, map_uid: Uuid) -> Option<Reindex> {
        self.known().get(&map_uid).cloned()
    }

    pub(super) fn forget(&self, map_uid: Uuid) {
        self.known().remove(&map_uid);
    }

    /// Begins one, unless one goes on.
    fn begin(&self, map: &Map, reindex: Reindex) -> Result<(), ServiceError> {
        let mut known = self.known();
        if known.get(&map.uid).is_some_and(|known| known.state == ReindexState::Running) {
            let detail = format!(
                "the map {} is being reindexed; GET /maps/{} says how far that has come",
                map.name, map.name
            );
            return Err(ServiceError::new(ErrorKind::Conflict, detail));
        }
        known.insert(map.uid, reindex);
        Ok(())
    }

    fn step(&self, map_uid: Uuid, images: usize) {
        if let Some(reindex) = self.known().get_mut(&map_uid) {
            reindex.done += 1;
            reindex.total = images.max(reindex.done);
        }
    }

    fn end(&self, map_uid: Uuid, error: Option<String>) {
        if let Some(reindex) = self.known().get_mut(&map_uid) {
            reindex.state = match error {
                None => ReindexState::Succeeded,
                Some(_) => ReindexState::Failed,
            };
            reindex.error = error;
            reindex.finished_at = Some(Timestamp::now());
        }
    }

    fn known(&self) -> MutexGuard<'_, BTreeMap<Uuid, Reindex>> {
        self.known.lock()
    }
}

impl Service {
    /// Begins to make all descriptors of a map anew, and answers at once.
    pub async fn reindex(
        self: &Arc<Self>,
        name: &MapName,
        request: ReindexRequest,
    ) -> Result<MapState, ServiceError> {
        let map = self.known_map(name).await?;
        let model = request.model.unwrap_or_else(|| map.model.clone());
        let descriptor = request.descriptor.unwrap_or(map.descriptor);
        dimension(&self.manifest(&model).await?, descriptor)?;
        let begun = Reindex {
            model: model.clone(),
            descriptor,
            state: ReindexState::Running,
            done: 0,
            total: self.maps.index_state(&map).await?.images,
            error: None,
            started_at: Timestamp::now(),
            finished_at: None,
        };
        self.reindexes.begin(&map, begun)?;
        tracing::info!(map = %name, from = map.model, to = model, "reindexing");
        let (service, name) = (Arc::clone(self), name.clone());
        let state = self.state_of(&name).await;
        tokio::spawn(async move {
            let outcome = service.make_anew(&map, &model, descriptor).await;
            match &outcome {
                Ok(()) => tracing::info!(map = %name, model, "reindexed"),
                Err(error) => tracing::warn!(map = %name, model, %error, "not reindexed"),
            }
            service.reindexes.end(map.uid, outcome.err().map(|error| error.detail));
        });
        state
    }

    async fn make_anew(
        &self,
        map: &Map,
        model: &str,
        descriptor: DescriptorKind,
    ) -> Result<(), ServiceError> {
        let extractor = patiently(|| self.installed_model(model)).await?;
        let next = Map {
            model: model.to_owned(),
            model_digest: extractor.digest(),
            precision: extractor.execution().precision,
            dim: dimension(extractor.manifest(), descriptor)?,
            descriptor,
            revision: map.revision + 1,
            ..map.clone()
        };
        let mut draft = self.drafts.draft(next).await?;
        let filled = self.fill(draft.as_mut(), map, &extractor, descriptor).await;
        if filled.is_err() {
            draft.discard().await;
        }
        filled
    }

    async fn fill(
        &self,
        draft: &mut dyn Draft,
        map: &Map,
        extractor: &Arc<Extractor>,
        descriptor: DescriptorKind,
    ) -> Result<(), ServiceError> {
        loop {
            let missing = draft.missing(PAGE).await?;
            if missing.is_empty() && draft.replace().await? {
                return Ok(());
            }
            for image in missing {
                let made = self.descriptor_anew(map, &image, extractor, descriptor).await?;
                if let Some(made) = made {
                    draft.write(&image, made).await?;
                    let images = self.maps.index_state(map).await?.images;
                    self.reindexes.step(map.uid, images);
                }
            }
        }
    }

    /// The new descriptor of an image; `None` if it was removed meanwhile.
    async fn descriptor_anew(
        &self,
        map: &Map,
        image: &Image,
        extractor: &Arc<Extractor>,
        descriptor: DescriptorKind,
    ) -> Result<Option<Descriptor>, ServiceError> {
        let Some(bytes) = self.blobs.blob(&image.digest).await? else {
            return match self.maps.image(map, &image.id).await? {
                Some(still) if still.digest == image.digest => {
                    Err(left_behind(image, "its bytes are missing from the store"))
                }
                _ => Ok(None),
            };
        };
        let _turn = self.reindexes.turn.acquire().await;
        // It waits for as long as anybody else does.
        let (features, demand) = (FeatureSet::DescriptorOnly, AdmissionRequest::BACKGROUND);
        match self.extract(extractor, bytes, descriptor, features, demand).await {
            Ok(extraction) => Ok(Some(extraction.descriptor)),
            Err(error) => Err(left_behind(image, &error.detail)),
        }
    }
}

/// Does it as soon as there is room among the models in memory.
async fn patiently<T, F>(work: impl Fn() -> F) -> Result<T, ServiceError>
where
    F: Future<Output = Result<T, ServiceError>>,
{
    loop {
        match work().await {
            Err(error) if error.kind == ErrorKind::Overloaded => tokio::time::sleep(PAUSE).await,
            ended => return ended,
        }
    }
}

fn left_behind(image: &Image, why: &str) -> ServiceError {
    ServiceError::unprocessable(format!(
        "the image {:?} cannot get a new descriptor: {why}; delete it, or put that right, and \
         reindex again",
        image.id.as_str()
    ))
}
