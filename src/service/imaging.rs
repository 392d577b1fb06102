//! Images in memory: admission, decoding, extraction by the model of a map, and thumbnails.

use std::sync::Arc;

use bytes::Bytes;
use tokio_util::sync::CancellationToken;
use whereabouts_api::ErrorKind;
use whereabouts_core::{DescriptorKind, MediaType};
use whereabouts_store::MapStore;
use whereabouts_vision::{
    Admission, AdmissionRequest, CpuPool, ExtractError, Extraction, Extractor, LoadedModels,
    Manifest, Permit, PoolError, Rejected, WorkClass, decode, preprocess,
};

use super::models::unusable;
use super::{ServiceError, ServiceMetrics};

/// Decodes images and runs models on them, as many at a time as there are permits. Clones share the permits, the
/// threads and the models.
#[derive(Clone)]
pub struct Imaging {
    /// The maps, whose precision a model that is loaded must have.
    pub maps: Arc<dyn MapStore>,
    /// The models in memory.
    pub models: LoadedModels,
    /// Permits to decode and infer.
    pub admission: Arc<Admission>,
    /// The threads that decode.
    pub pool: CpuPool,
    /// Counts rejections and stages.
    pub metrics: Arc<ServiceMetrics>,
}

impl Imaging {
    /// Whether there is room for a picture; whoever is refused need not send it.
    pub fn check_admission(&self, demand: AdmissionRequest) -> Result<(), ServiceError> {
        self.admission.check(demand).map_err(|refused| self.counted(refused))
    }

    /// Waits for the permit to decode and infer one picture.
    pub(crate) async fn admit(&self, demand: AdmissionRequest) -> Result<Permit, ServiceError> {
        self.admission.enter(demand).await.map_err(|refused| self.counted(refused))
    }

    fn counted(&self, refused: Rejected) -> ServiceError {
        self.metrics.refusals.count(refused.reason.into());
        refused.into()
    }

    /// Decodes a picture, runs it through the model and makes its descriptor, once there is a permit
    /// for it. A caller who leaves stops that at the next step.
    pub(crate) async fn extract(
        &self,
        extractor: &Arc<Extractor>,
        bytes: Bytes,
        kind: DescriptorKind,
        demand: AdmissionRequest,
    ) -> Result<Extraction, ServiceError> {
        let permit = Arc::new(self.admit(demand).await?);
        let gone = CancellationToken::new();
        let _unless_dropped = gone.clone().drop_guard();
        let (beginning, decoding) = (Arc::clone(extractor), Arc::clone(&permit));
        let begin = move || {
            // Whoever leaves now gives the permit back when the thread is free.
            let _decoding = decoding;
            beginning.begin(&bytes, || !gone.is_cancelled())
        };
        let extracting = self.on_pool(begin).await?;
        let inferred = extracting.inferred().await?;
        // Not by the pool, where it would wait although nearly all is done.
        let extractor = Arc::clone(extractor);
        let finishing = tokio::task::spawn_blocking(move || extractor.finish(inferred, kind)).await;
        let extraction = finishing
            .map_err(|error| ServiceError::new(ErrorKind::Internal, error.to_string()))??;
        permit.served();
        Ok(extraction)
    }

    /// A picture as it was sent, or as a JPEG no larger than `max_edge` pixels.
    pub(crate) async fn thumbnail(
        &self,
        media_type: MediaType,
        bytes: Bytes,
        max_edge: Option<u32>,
    ) -> Result<(MediaType, Bytes), ServiceError> {
        let Some(max_edge) = max_edge else { return Ok((media_type, bytes)) };
        if !(16..=4096).contains(&max_edge) {
            return Err(ServiceError::unprocessable("max_edge must be between 16 and 4096 pixels"));
        }
        let limits = self.models.limits();
        let permit =
            self.admit(AdmissionRequest { class: WorkClass::Index, deadline: None }).await?;
        let jpeg = self
            .on_pool(move || {
                let _permit = permit;
                let picture =
                    decode::decode(&bytes, limits, decode::Needed::LongestEdge(max_edge))?;
                let small = preprocess::shrink_to(&picture.pixels, max_edge)?;
                Ok(decode::encode_jpeg(&small)?)
            })
            .await?;
        Ok((MediaType::Jpeg, jpeg.into()))
    }

    /// A model as it is installed, for descriptors yet to be made: at the precision that the
    /// settings say, else at that of the maps which have it already.
    pub async fn installed_model(&self, name: &str) -> Result<Arc<Extractor>, ServiceError> {
        let precision = match self.models.precision() {
            Some(precision) => Some(precision),
            None => {
                let maps = self.maps.maps().await?;
                maps.iter().find(|map| map.model == name).map(|map| map.precision)
            }
        };
        self.models.installed(name, precision).await.map_err(|error| unusable(name, error))
    }

    /// What an installed model says about itself.
    pub(crate) async fn manifest(&self, name: &str) -> Result<Manifest, ServiceError> {
        let (models, wanted) = (self.models.clone(), name.to_owned());
        tokio::task::spawn_blocking(move || models.manifest(&wanted))
            .await
            .map_err(|error| ServiceError::new(ErrorKind::Internal, error.to_string()))?
            .map_err(|error| unusable(name, error))
    }

    async fn on_pool<T, F>(&self, work: F) -> Result<T, ServiceError>
    where
        T: Send + 'static,
        F: FnOnce() -> Result<T, ExtractError> + Send + 'static,
    {
        match self.pool.run(work).await {
            Ok(result) => Ok(result?),
            Err(PoolError::Overloaded(overloaded)) => Err(overloaded.into()),
            Err(error @ PoolError::BrokeOff) => {
                Err(ServiceError::new(ErrorKind::Internal, error.to_string()))
            }
        }
    }
}
