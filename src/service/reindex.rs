//! Reindexing: computes new descriptors for a whole map, while the old ones answer searches. The switch to the
//! new ones is one step of the store.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::{Mutex, MutexGuard};
use tokio::sync::Semaphore;
use uuid::Uuid;

use super::fitting::{Fitting, KnownDescriptors, no_vocabulary};
use super::models::{descriptor_of, kind_of};
use super::{Maps, ServiceError, VocabularySettings};
use bytes::Bytes;
use whereabouts_api::{
    ErrorKind, MapState, Reindex, ReindexRequest, ReindexState, VocabularyChoice,
};
use whereabouts_core::{Descriptor, DescriptorKind, Image, Map, MapName};
use whereabouts_store::{BlobStore, Draft, DraftStore};
use whereabouts_vision::{AdmissionRequest, DescriptorSpec, Extractor, FeatureSet};

/// Images that are read at a time.
const PAGE: usize = 256;

/// Pause between two attempts to load the model while all loaded models are in use.
const LOAD_RETRY_PAUSE: Duration = Duration::from_millis(50);

/// The state of the last reindex of each map, in memory.
#[derive(Debug)]
pub struct Reindexes {
    /// By the uid of the map.
    known: Mutex<BTreeMap<Uuid, Reindex>>,
    /// Maps that stay with the model's vocabulary, by uid.
    declined: Mutex<BTreeMap<Uuid, Declined>>,
    /// Limits reindexing to one image at a time over all maps, because it shares the model with robots.
    pub(super) extraction: Semaphore,
}

/// Why the background left a map with the model's vocabulary.
#[derive(Debug, Clone)]
pub(super) struct Declined {
    /// Number of images in the map then.
    pub images: usize,
    pub why: String,
}

/// What the background does with the vocabulary of a map that has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FitPlan {
    /// Fits one, and takes the better of it and the model's.
    Choose,
    /// Fits one, which was asked for.
    Renew,
    /// Returns to the model's.
    Drop,
}

impl Default for Reindexes {
    fn default() -> Self {
        let (known, declined) = (Mutex::default(), Mutex::default());
        Self { known, declined, extraction: Semaphore::new(1) }
    }
}

impl Reindexes {
    pub(super) fn get(&self, map_uid: Uuid) -> Option<Reindex> {
        self.known().get(&map_uid).cloned()
    }

    pub(super) fn forget(&self, map_uid: Uuid) {
        self.known().remove(&map_uid);
        self.declined.lock().remove(&map_uid);
    }

    pub(super) fn declined(&self, map: &Map) -> Option<Declined> {
        self.declined.lock().get(&map.uid).cloned()
    }

    pub(super) fn decline(&self, map: &Map, declined: Declined) {
        tracing::info!(map = %map.name, why = declined.why, "the map keeps the model's vocabulary");
        self.declined.lock().insert(map.uid, declined);
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

    /// Records that another image of a running reindex is done.
    fn step(&self, map_uid: Uuid, images: usize) {
        self.progress(map_uid, |done| done + 1, images);
    }

    /// Records that this many images of a running reindex are done.
    pub(super) fn set_done(&self, map_uid: Uuid, done: usize) {
        self.progress(map_uid, |_| done, 0);
    }

    fn progress(&self, map_uid: Uuid, done: impl FnOnce(usize) -> usize, images: usize) {
        if let Some(reindex) = self.known().get_mut(&map_uid)
            && reindex.state == ReindexState::Running
        {
            reindex.done = done(reindex.done);
            reindex.total = images.max(reindex.total).max(reindex.done);
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
    /// When maps get a vocabulary of their own.
    pub settings: VocabularySettings,
}

/// How the descriptors of a map are to be made.
#[derive(Debug, Clone)]
struct Target {
    model: String,
    descriptor: DescriptorKind,
    vocabulary: Option<VocabularyChoice>,
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
        let vocabulary = request.vocabulary;
        if vocabulary == Some(VocabularyChoice::Own) && !manifest.may_have_own(descriptor) {
            return Err(no_vocabulary(&manifest, descriptor));
        }
        let target = Target { model, descriptor, vocabulary };
        self.begin(&map, &target).await?;
        tracing::info!(map = %name, from = map.model, to = target.model, "reindexing");
        let (reindexer, name) = (self.clone(), name.clone());
        let state = self.maps.state_of(&name).await;
        tokio::spawn(async move {
            let result = reindexer.run(&map, &target).await;
            let model = &target.model;
            match &result {
                Ok(()) => tracing::info!(map = %name, model, "reindexed"),
                Err(error) => tracing::warn!(map = %name, model, %error, "reindexing failed"),
            }
            reindexer.maps.reindexes.end(map.uid, result.err().map(|error| error.detail));
        });
        state
    }

    async fn begin(&self, map: &Map, target: &Target) -> Result<(), ServiceError> {
        let begun = Reindex {
            model: target.model.clone(),
            descriptor: target.descriptor,
            state: ReindexState::Running,
            done: 0,
            total: self.maps.store.index_state(map).await?.images,
            error: None,
            started_at: Timestamp::now(),
            finished_at: None,
        };
        self.maps.reindexes.begin(map, begun)
    }

    async fn run(&self, map: &Map, target: &Target) -> Result<(), ServiceError> {
        let Target { model, descriptor, vocabulary } = target;
        let extractor = retry_while_overloaded(|| self.maps.imaging.installed_model(model)).await?;
        let fitting = match vocabulary {
            Some(VocabularyChoice::Own) => self.fit(map, &extractor, *descriptor, true).await?,
            _ => Fitting::default(),
        };
        let keeps_shipped = match vocabulary {
            Some(choice) => *choice == VocabularyChoice::Shipped,
            None => map.keeps_shipped,
        };
        let next =
            Map { model: model.clone(), descriptor: *descriptor, keeps_shipped, ..map.clone() };
        self.change_over(map, next, &extractor, fitting).await
    }

    /// Fits a vocabulary without having been asked, and changes over to it unless the model's is better. Returns whether
    /// the descriptors of the map have changed.
    pub(super) async fn fit_in_background(
        &self,
        map: &Map,
        images: usize,
        plan: FitPlan,
    ) -> Result<bool, ServiceError> {
        let manifest = self.maps.imaging.manifest(&map.model).await?;
        if map.vocabulary.is_none() && !manifest.may_have_own(map.descriptor) {
            return Ok(false);
        }
        let (_, extractor, _) = self.maps.usable(&map.name).await?;
        let fitting = match plan {
            FitPlan::Drop => Fitting::default(),
            FitPlan::Choose => self.fit(map, &extractor, map.descriptor, false).await?,
            FitPlan::Renew => self.fit(map, &extractor, map.descriptor, true).await?,
        };
        if fitting.fitted.is_none() {
            let why = match &fitting.agreement {
                Some(rates) => format!(
                    "the model's was measured to be better: the nearest image is found for {:.0} % of the images, with \
                     an own one for {:.0} %",
                    100.0 * rates.shipped,
                    100.0 * rates.own
                ),
                None => "the map has grown beyond vocabulary.max_images".to_owned(),
            };
            self.maps.reindexes.decline(map, Declined { images, why });
            if map.vocabulary.is_none() {
                return Ok(false);
            }
        }
        let vocabulary =
            fitting.fitted.as_ref().map_or(VocabularyChoice::Shipped, |_| VocabularyChoice::Own);
        let target = Target {
            model: map.model.clone(),
            descriptor: map.descriptor,
            vocabulary: Some(vocabulary),
        };
        self.begin(map, &target).await?;
        let result = self.change_over(map, map.clone(), &extractor, fitting).await;
        match &result {
            Ok(()) => tracing::info!(map = %map.name, ?vocabulary, "changed the vocabulary"),
            Err(error) => tracing::warn!(map = %map.name, %error, "the vocabulary was not changed"),
        }
        let error = result.as_ref().err().map(|error| error.detail.clone());
        self.maps.reindexes.end(map.uid, error);
        result.map(|()| true)
    }

    /// Replaces the descriptors of a map. `next` is the map as it will be, apart from what follows from the model and
    /// the vocabulary.
    async fn change_over(
        &self,
        map: &Map,
        next: Map,
        extractor: &Arc<Extractor>,
        fitting: Fitting,
    ) -> Result<(), ServiceError> {
        let Fitting { fitted, known, .. } = fitting;
        let kind = next.descriptor;
        let (shipped, dim) = descriptor_of(extractor, kind)?;
        let record = fitted.as_ref().map(|fitted| fitted.record);
        let own = record.and_then(|own| extractor.own_digest(kind, own.digest));
        let next = Map {
            model_digest: own.unwrap_or(shipped),
            precision: extractor.execution().precision,
            dim,
            revision: map.revision + 1,
            vocabulary: record,
            ..next
        };
        let mut pin = None;
        let vocabulary = match fitted {
            Some(fitted) => {
                let bytes = Bytes::from(fitted.bytes);
                pin = Some(self.blobs.put_blob(fitted.record.digest, bytes).await?);
                let keep = Arc::clone(&fitted.vocabulary);
                self.maps.imaging.vocabularies.keep(next.model_digest, keep);
                Some(fitted.vocabulary)
            }
            None => None,
        };
        let spec = DescriptorSpec { kind, vocabulary };
        // The progress of the fit was that of another count.
        self.maps.reindexes.set_done(map.uid, 0);
        let mut draft = self.drafts.draft(next).await?;
        let filled = self.fill(draft.as_mut(), map, extractor, &spec, known).await;
        if filled.is_err() {
            draft.discard().await;
        }
        drop(pin);
        filled
    }

    async fn fill(
        &self,
        draft: &mut dyn Draft,
        map: &Map,
        extractor: &Arc<Extractor>,
        spec: &DescriptorSpec,
        mut known: KnownDescriptors,
    ) -> Result<(), ServiceError> {
        loop {
            let missing = draft.missing(PAGE).await?;
            if missing.is_empty() && draft.replace().await? {
                return Ok(());
            }
            for image in missing {
                let ready = known.remove(&image.id).filter(|(digest, _)| *digest == image.digest);
                let extracted = match ready {
                    Some((_, descriptor)) => Some(descriptor),
                    None => self.new_descriptor(map, &image, extractor, spec).await?,
                };
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
        spec: &DescriptorSpec,
    ) -> Result<Option<Descriptor>, ServiceError> {
        let Some(bytes) = self.bytes_of(map, image).await? else { return Ok(None) };
        let _permit = self.maps.reindexes.extraction.acquire().await;
        let (features, request) = (FeatureSet::DescriptorOnly, AdmissionRequest::BACKGROUND);
        match self.maps.imaging.extract(extractor, bytes, spec.clone(), features, request).await {
            Ok(extraction) => Ok(Some(extraction.descriptor)),
            Err(error) => Err(cannot_reindex(image, &error.detail)),
        }
    }

    /// The bytes of an image; `None` if the image was deleted meanwhile.
    pub(super) async fn bytes_of(
        &self,
        map: &Map,
        image: &Image,
    ) -> Result<Option<Bytes>, ServiceError> {
        if let Some(bytes) = self.blobs.blob(&image.digest).await? {
            return Ok(Some(bytes));
        }
        match self.maps.store.image(map, &image.id).await? {
            Some(current) if current.digest == image.digest => {
                Err(cannot_reindex(image, "its bytes are missing from the store"))
            }
            _ => Ok(None),
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

pub(super) fn cannot_reindex(image: &Image, why: &str) -> ServiceError {
    ServiceError::unprocessable(format!(
        "the image {:?} cannot get a new descriptor: {why}; fix that or delete it, and then \
         reindex again",
        image.id.as_str()
    ))
}
