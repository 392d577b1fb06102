//! Images in memory: admission, decoding, extraction by a model, and thumbnails. Which model a map needs is
//! for `models`.

use std::sync::Arc;

use bytes::Bytes;
use tokio_util::sync::CancellationToken;
use whereabouts_api::ErrorKind;
use whereabouts_core::{Digest, MediaType};
use whereabouts_store::MapStore;
use whereabouts_vision::exif::{GpsReading, gps};
use whereabouts_vision::{
    Admission, AdmissionRequest, CpuPool, DescriptorSpec, ExtractError, Extraction, Extractor,
    FeatureSet, LoadedModels, Manifest, Permit, PoolError, RawPixels, Rejected, WorkClass, decode,
    preprocess,
};

use super::models::unusable;
use super::{ServiceError, ServiceMetrics, Vocabularies};

/// Decodes images and runs models on them, at most as many at a time as there are permits. Clones share the
/// permits, the threads and the models.
#[derive(Clone)]
pub struct Imaging {
    /// The maps; a model is loaded at the precision of the maps that use it.
    pub maps: Arc<dyn MapStore>,
    /// The loaded models.
    pub models: LoadedModels,
    /// The loaded vocabularies of maps.
    pub vocabularies: Arc<Vocabularies>,
    /// Permits to decode an image and run a model on it.
    pub admission: Arc<Admission>,
    /// The threads for decoding.
    pub pool: CpuPool,
    /// Counts rejections.
    pub metrics: Arc<ServiceMetrics>,
}

/// What the bytes of a picture say without being decoded.
#[derive(Debug)]
pub(crate) struct PictureFacts {
    /// Their digest.
    pub digest: Digest,
    /// The position in its metadata.
    pub gps: GpsReading,
}

impl Imaging {
    /// Rejects a picture that would not be admitted now, so that the caller need not send it.
    pub fn check_admission(&self, request: AdmissionRequest) -> Result<(), ServiceError> {
        self.admission.check(request).map_err(|rejected| self.counted(rejected))
    }

    /// Waits for a permit to decode one picture and run a model on it.
    pub(crate) async fn admit(&self, request: AdmissionRequest) -> Result<Permit, ServiceError> {
        self.admission.acquire(request).await.map_err(|rejected| self.counted(rejected))
    }

    fn counted(&self, rejected: Rejected) -> ServiceError {
        self.metrics.refusals.count(rejected.reason.into());
        rejected.into()
    }

    /// Waits for a permit, decodes a picture and extracts its descriptor. Dropping the future stops the work
    /// at the next step.
    pub(crate) async fn extract(
        &self,
        extractor: &Arc<Extractor>,
        bytes: Bytes,
        spec: DescriptorSpec,
        features: FeatureSet,
        request: AdmissionRequest,
    ) -> Result<Extraction, ServiceError> {
        let permit = Arc::new(self.admit(request).await?);
        self.extract_with(permit, extractor, bytes, spec, features).await
    }

    /// Like [`Imaging::extract`], with a permit that the caller has.
    pub(crate) async fn extract_with(
        &self,
        permit: Arc<Permit>,
        extractor: &Arc<Extractor>,
        bytes: Bytes,
        spec: DescriptorSpec,
        features: FeatureSet,
    ) -> Result<Extraction, ServiceError> {
        let cancelled = CancellationToken::new();
        let _cancel_on_drop = cancelled.clone().drop_guard();
        let (decoder, decoding_permit) = (Arc::clone(extractor), Arc::clone(&permit));
        let decode = move || {
            // Held until the thread is free, even if the caller has gone.
            let _permit = decoding_permit;
            decoder.begin(&bytes, spec, features, || !cancelled.is_cancelled())
        };
        let extraction = self.on_pool(decode).await?.result().await?;
        permit.complete();
        Ok(extraction)
    }

    /// Hashes a picture and reads the position in its metadata.
    pub(crate) async fn examine(
        &self,
        permit: &Arc<Permit>,
        bytes: Bytes,
    ) -> Result<PictureFacts, ServiceError> {
        let permit = Arc::clone(permit);
        let examine = move || {
            let _permit = permit;
            Ok(PictureFacts { digest: Digest::of(&bytes), gps: gps(&bytes) })
        };
        self.on_pool(examine).await
    }

    /// Decodes a picture only to say what is wrong with it.
    pub(crate) async fn warnings(
        &self,
        permit: Arc<Permit>,
        bytes: Bytes,
    ) -> Result<Vec<String>, ServiceError> {
        let limits = self.models.limits();
        let decode = move || {
            let _permit = permit;
            Ok(decode::decode(&bytes, limits, decode::Needed::Size(16, 16))?.warnings)
        };
        let warnings: Vec<String> = self.on_pool(decode).await?;
        self.metrics.count_damage(&warnings);
        Ok(warnings)
    }

    /// Returns pixels without a file format as PNG.
    pub async fn png_of(&self, raw: RawPixels, bytes: Bytes) -> Result<Bytes, ServiceError> {
        let limits = self.models.limits();
        let png = self.pool.run(move || raw.to_png(&bytes, limits)).await;
        match png {
            Ok(Ok(png)) => Ok(png.into()),
            Ok(Err(error)) => Err(ServiceError::unprocessable(error.to_string())),
            Err(PoolError::Overloaded(overloaded)) => Err(overloaded.into()),
            Err(error @ PoolError::Aborted) => {
                Err(ServiceError::new(ErrorKind::Internal, error.to_string()))
            }
        }
    }

    /// Returns a picture as it was uploaded, or as a JPEG whose longer edge is at most `max_edge` pixels.
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

    /// Loads a model as it is installed now, for new descriptors: at the configured precision, else at that of
    /// the maps that use it already.
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

    /// Reads the manifest of an installed model.
    pub(crate) async fn manifest(&self, name: &str) -> Result<Manifest, ServiceError> {
        let (models, model) = (self.models.clone(), name.to_owned());
        tokio::task::spawn_blocking(move || models.manifest(&model))
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
            Err(error @ PoolError::Aborted) => {
                Err(ServiceError::new(ErrorKind::Internal, error.to_string()))
            }
        }
    }
}
