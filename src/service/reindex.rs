//! Reindexing: computes new descriptors for a whole map, while the old ones answer searches. The switch to the
//! new ones is one step of the store.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::{Mutex, MutexGuard};
use tokio::sync::Semaphore;
use uuid::Uuid;

use super::models::{descriptor_of, kind_of};
use super::{Maps, ServiceError};
use whereabouts_api::{ErrorKind, MapState, Reindex, ReindexRequest, ReindexState};
use whereabouts_core::{Descriptor, DescriptorKind, Image, Map, MapName};
use whereabouts_store::{BlobStore, Draft, DraftStore};
use whereabouts_vision::{AdmissionRequest, Extractor, FeatureSet};

/// Images that are read at a time.
const PAGE: usize = 256;

/// Pause between two attempts to load the model while all loaded models are in use.
const LOAD_RETRY_PAUSE: Duration = Duration::from_millis(50);

/// The state of the last reindex of each map, in memory.
#[derive(Debug)]
pub struct Reindexes {
    /// By the uid of the map.
    known: Mutex<BTreeMap<Uuid, Reindex>>,
    /// Limits reindexing to one image at a time over all maps, because it shares the model with robots.
    extraction: Semaphore,
}

impl Default for Reindexes {
    fn default() -> Self {
        Self { known: Mutex::default(), extraction: Semaphore::new(1) }
    }
}

impl Reindexes {
    pub(super) fn get(&self, map_uid: Uuid) -> Option<Reindex> {
        self.known().get(&map_uid).cloned()
    }

    pub(super) fn forget(&self, map_uid: Uuid) {
        self.known().remove(&map_uid);
    }

    /// Records the start of a reindex; a conflict if one of the same map is running.
    fn begin(&self, map: &Map, reindex: Reindex) -> Result<(), ServiceError> {
        let mut known = self.known();
        if known.get(&map.uid).is_some_and(|known| known.state == ReindexState::Running) {
            let detail = format!(
                "the map {} is being reindexed; GET /maps/{} shows its progress",
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

/// Recomputes all descriptors of a map with another model, or with its own as it is installed now. Clones share
/// the state.
#[derive(Clone)]
pub struct Reindexer {
    /// The maps.
    pub maps: Maps,
    /// Drafts of new descriptors.
    pub drafts: Arc<dyn DraftStore>,
    /// The bytes of the images.
    pub blobs: Arc<dyn BlobStore>,
}

impl Reindexer {
    /// Starts a reindex in the background and returns the state of the map.
    pub async fn start(
        &self,
        name: &MapName,
        request: ReindexRequest,
    ) -> Result<MapState, ServiceError> {
        let map = self.maps.find(name).await?;
        let model = request.model.unwrap_or_else(|| map.model.clone());
        let manifest = self.maps.imaging.manifest(&model).await?;
        let descriptor = kind_of(&manifest, request.descriptor, Some(map.descriptor))?;
        let begun = Reindex {
            model: model.clone(),
            descriptor,
            state: ReindexState::Running,
            done: 0,
            total: self.maps.store.index_state(&map).await?.images,
            error: None,
            started_at: Timestamp::now(),
            finished_at: None,
        };
        self.maps.reindexes.begin(&map, begun)?;
        tracing::info!(map = %name, from = map.model, to = model, "reindexing");
        let (reindexer, name) = (self.clone(), name.clone());
        let state = self.maps.state_of(&name).await;
        tokio::spawn(async move {
            let result = reindexer.run(&map, &model, descriptor).await;
            match &result {
                Ok(()) => tracing::info!(map = %name, model, "reindexed"),
                Err(error) => tracing::warn!(map = %name, model, %error, "reindexing failed"),
            }
            reindexer.maps.reindexes.end(map.uid, result.err().map(|error| error.detail));
        });
        state
    }

    async fn run(
        &self,
        map: &Map,
        model: &str,
        descriptor: DescriptorKind,
    ) -> Result<(), ServiceError> {
        let extractor = retry_while_overloaded(|| self.maps.imaging.installed_model(model)).await?;
        let (model_digest, dim) = descriptor_of(&extractor, descriptor)?;
        let next = Map {
            model: model.to_owned(),
            model_digest,
            precision: extractor.execution().precision,
            dim,
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
                let extracted = self.new_descriptor(map, &image, extractor, descriptor).await?;
                if let Some(extracted) = extracted {
                    draft.write(&image, extracted).await?;
                    let images = self.maps.store.index_state(map).await?.images;
                    self.maps.reindexes.step(map.uid, images);
                }
            }
        }
    }

    /// Extracts the new descriptor of an image; `None` if the image was deleted meanwhile.
    async fn new_descriptor(
        &self,
        map: &Map,
        image: &Image,
        extractor: &Arc<Extractor>,
        descriptor: DescriptorKind,
    ) -> Result<Option<Descriptor>, ServiceError> {
        let Some(bytes) = self.blobs.blob(&image.digest).await? else {
            return match self.maps.store.image(map, &image.id).await? {
                Some(current) if current.digest == image.digest => {
                    Err(cannot_reindex(image, "its bytes are missing from the store"))
                }
                _ => Ok(None),
            };
        };
        let _permit = self.maps.reindexes.extraction.acquire().await;
        let (features, request) = (FeatureSet::DescriptorOnly, AdmissionRequest::BACKGROUND);
        match self.maps.imaging.extract(extractor, bytes, descriptor, features, request).await {
            Ok(extraction) => Ok(Some(extraction.descriptor)),
            Err(error) => Err(cannot_reindex(image, &error.detail)),
        }
    }
}

/// Repeats `work` while it is overloaded: while all loaded models are in use.
async fn retry_while_overloaded<T, F>(work: impl Fn() -> F) -> Result<T, ServiceError>
where
    F: Future<Output = Result<T, ServiceError>>,
{
    loop {
        match work().await {
            Err(error) if error.kind == ErrorKind::Overloaded => {
                tokio::time::sleep(LOAD_RETRY_PAUSE).await
            }
            ended => return ended,
        }
    }
}

fn cannot_reindex(image: &Image, why: &str) -> ServiceError {
    ServiceError::unprocessable(format!(
        "the image {:?} cannot get a new descriptor: {why}; fix that or delete it, and then \
         reindex again",
        image.id.as_str()
    ))
}
