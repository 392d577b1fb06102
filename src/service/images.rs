//! Reference images: add, list, show, remove.

use std::sync::Arc;

use bytes::Bytes;
use jiff::Timestamp;
use tokio_util::sync::CancellationToken;

use super::{SUPERSEDED, Service, ServiceError};
use whereabouts_api::{ErrorKind, ImageMeta, ImagePage};
use whereabouts_core::{DescriptorKind, Image, ImageId, Map, MapName, MediaType, Pose};
use whereabouts_store::{Added, StoreError};
use whereabouts_vision::{
    AdmissionRequest, ExtractError, Extraction, Extractor, FeatureSet, PoolError, WorkClass,
    decode, preprocess,
};

/// An image to add.
#[derive(Debug)]
pub struct NewImage {
    /// Its bytes: JPEG, PNG or WebP.
    pub bytes: Bytes,
    /// What the caller says about it.
    pub meta: ImageMeta,
    /// How urgent it is.
    pub demand: AdmissionRequest,
}

impl Service {
    /// Stores an image with its descriptor.
    pub async fn add_image(&self, map: &MapName, new: NewImage) -> Result<Added, ServiceError> {
        if new.bytes.is_empty() {
            return Err(empty_body());
        }
        let (mut pin, mut left) = (None, SUPERSEDED);
        loop {
            let (map, extractor) = self.usable_map(map).await?;
            let meta = CheckedMeta::new(new.meta.clone(), &map)?;
            let bytes = new.bytes.clone();
            let (kind, features) = (map.descriptor, FeatureSet::DescriptorOnly);
            let extraction = self.extract(&extractor, bytes, kind, features, new.demand).await?;
            self.metrics.observe_extraction(&extraction);
            let digest = extraction.digest;
            let image = Image {
                id: meta.id.unwrap_or_else(|| ImageId::from_digest(&digest)),
                digest,
                pose: meta.pose,
                captured_at: meta.captured_at,
                tags: meta.tags,
                media_type: extraction.media_type,
                width: extraction.width,
                height: extraction.height,
                created_at: Timestamp::now(),
            };
            if pin.is_none() {
                pin = Some(self.blobs.put_blob(digest, new.bytes.clone()).await?);
            }
            match self.maps.add_image(&map, image, extraction.descriptor).await {
                // Its descriptor is of the model that the map had a moment ago.
                Err(StoreError::Superseded(_)) if left > 0 => left -= 1,
                added => return Ok(added?),
            }
        }
    }

    /// One image.
    pub async fn get_image(&self, map: &MapName, id: &ImageId) -> Result<Image, ServiceError> {
        let map = self.known_map(map).await?;
        self.maps.image(&map, id).await?.ok_or_else(|| no_image(&map.name, id))
    }

    /// Images by id, a page at a time.
    pub async fn list_images(
        &self,
        map: &MapName,
        cursor: Option<&ImageId>,
        limit: Option<usize>,
    ) -> Result<ImagePage, ServiceError> {
        let limit = page_size(limit)?;
        let map = self.known_map(map).await?;
        let mut images = self.maps.images(&map, cursor, limit + 1).await?;
        let next_cursor = (images.len() > limit)
            .then(|| images.get(limit - 1).map(|image| image.id.to_string()))
            .flatten();
        images.truncate(limit);
        Ok(ImagePage { images, next_cursor })
    }

    /// The picture itself: as it was sent, or as a JPEG no larger than `max_edge` pixels.
    pub async fn image_content(
        &self,
        map: &MapName,
        id: &ImageId,
        max_edge: Option<u32>,
    ) -> Result<(MediaType, Bytes), ServiceError> {
        let image = self.get_image(map, id).await?;
        let bytes = self.blobs.blob(&image.digest).await?.ok_or_else(|| {
            ServiceError::new(
                ErrorKind::Internal,
                format!("the bytes of {id} ({}) are missing from the store", image.digest),
            )
        })?;
        self.shown(image.media_type, bytes, max_edge).await
    }

    /// A picture as it was sent, or as a JPEG no larger than `max_edge` pixels.
    pub(super) async fn shown(
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

    /// Removes an image.
    pub async fn delete_image(&self, map: &MapName, id: &ImageId) -> Result<(), ServiceError> {
        let map = self.known_map(map).await?;
        match self.maps.delete_image(&map, id).await? {
            true => Ok(()),
            false => Err(no_image(&map.name, id)),
        }
    }

    /// Decodes a picture, runs it through the model and makes its descriptor, once there is a permit
    /// for it. A caller who leaves stops that at the next step.
    pub(super) async fn extract(
        &self,
        extractor: &Arc<Extractor>,
        bytes: Bytes,
        kind: DescriptorKind,
        features: FeatureSet,
        demand: AdmissionRequest,
    ) -> Result<Extraction, ServiceError> {
        let permit = Arc::new(self.admit(demand).await?);
        let gone = CancellationToken::new();
        let _unless_dropped = gone.clone().drop_guard();
        let (beginning, decoding) = (Arc::clone(extractor), Arc::clone(&permit));
        let begin = move || {
            // Whoever leaves now gives the permit back when the thread is free.
            let _decoding = decoding;
            beginning.begin(&bytes, kind, features, || !gone.is_cancelled())
        };
        let extraction = self.on_pool(begin).await?.result().await?;
        permit.complete();
        Ok(extraction)
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

/// What remains of [`ImageMeta`] when it is in order.
struct CheckedMeta {
    id: Option<ImageId>,
    pose: Option<Pose>,
    captured_at: Option<Timestamp>,
    tags: Vec<String>,
}

impl CheckedMeta {
    fn new(meta: ImageMeta, map: &Map) -> Result<Self, ServiceError> {
        check_tags(&meta.tags)?;
        Ok(Self {
            id: meta.id.map(|id| id.parse()).transpose()?,
            pose: meta.pose.map(|pose| pose.check(map.frame)).transpose()?,
            captured_at: meta.captured_at,
            tags: meta.tags,
        })
    }
}

pub(super) fn check_tags(tags: &[String]) -> Result<(), ServiceError> {
    let misfit = |tag: &String| tag.is_empty() || tag.chars().count() > 64;
    match tags.len() > 32 || tags.iter().any(misfit) {
        true => Err(ServiceError::unprocessable(
            "an image has at most 32 tags, each of 1 to 64 characters",
        )),
        false => Ok(()),
    }
}

pub(super) fn empty_body() -> ServiceError {
    ServiceError::malformed(
        "the body is empty; send the bytes of a picture, for example with curl --data-binary \
         @frame.jpg",
    )
}

pub(super) fn page_size(limit: Option<usize>) -> Result<usize, ServiceError> {
    match limit.unwrap_or(100) {
        limit @ 1..=1000 => Ok(limit),
        _ => Err(ServiceError::unprocessable("limit must be between 1 and 1000")),
    }
}

fn no_image(map: &MapName, id: &ImageId) -> ServiceError {
    ServiceError::not_found(format!("there is no image {:?} in the map {map}", id.as_str()))
}
