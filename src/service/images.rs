//! Reference images: add one, list, show and delete. Many at once are for `bulk`, changes of stored ones for
//! `corrections`, their copies in other stores for `transfer`.

use std::sync::Arc;

use bytes::Bytes;
use jiff::Timestamp;

use super::imaging::PictureFacts;
use super::{BulkSettings, Keys, Maps, SUPERSEDED_RETRIES, ServiceError};
use whereabouts_api::{ErrorKind, ImageAnswer, ImageMeta, ImagePage};
use whereabouts_core::{
    CoordinateFrame, Image, ImageId, Map, MapName, MediaType, Pose, PoseInput, Recording,
};
use whereabouts_store::{Added, BlobStore, StoreError};
use whereabouts_vision::exif::GpsReading;
use whereabouts_vision::{AdmissionRequest, FeatureSet};

/// An image to add.
#[derive(Debug)]
pub struct NewImage {
    /// Its bytes, in any format of [`MediaType`].
    pub bytes: Bytes,
    /// Its id, pose, time and tags.
    pub meta: ImageMeta,
    /// Its priority and deadline in the admission queue.
    pub demand: AdmissionRequest,
}

/// Reference images: add, list, show and delete. Clones share the store.
#[derive(Clone)]
pub struct Images {
    /// The maps of the images.
    pub maps: Maps,
    /// The bytes of the images.
    pub blobs: Arc<dyn BlobStore>,
    /// API keys, whose rate limits count each image of a bulk upload.
    pub keys: Arc<Keys>,
    /// Bounds of bulk uploads.
    pub bulk: BulkSettings,
}

impl Images {
    /// Extracts the descriptor of an image and stores both. A new image without a pose in a `wgs84` map gets that
    /// of its metadata. If the image is stored already, its pose, time and tags become those that `new` states, and
    /// nothing is extracted. Returns the image, and whether it is new.
    pub async fn add(
        &self,
        name: &MapName,
        new: NewImage,
    ) -> Result<(ImageAnswer, bool), ServiceError> {
        if new.bytes.is_empty() {
            return Err(empty_body());
        }
        let stated = StatedMeta::new(new.meta)?;
        let imaging = &self.maps.imaging;
        let (mut pin, mut retries) = (None, SUPERSEDED_RETRIES);
        let known = self.maps.find(name).await?;
        let stored = match &stated.id {
            Some(id) => self.maps.store.image(&known, id).await?,
            None => None,
        };
        // An image that is stored needs no model. Another may have to load it, which must not keep a permit.
        let mut usable = match &stored {
            Some(_) => None,
            None => Some(self.maps.usable(name).await?),
        };
        let permit = Arc::new(imaging.admit(new.demand).await?);
        let facts = imaging.examine(&permit, new.bytes.clone()).await?;
        let digest = facts.digest;
        let mut permit = Some(permit);
        if let Some(stored) = stored.filter(|stored| stored.digest == digest)
            && let Some(permit) = permit.take()
        {
            let warnings = imaging.warnings(permit, new.bytes.clone()).await?;
            let answer = self.present(&known, &stored.id, &stated, &new.bytes, &facts).await?;
            if let Some(answer) = answer {
                let warnings = [warnings, answer.warnings].concat();
                return Ok((ImageAnswer { warnings, ..answer }, false));
            }
        }
        loop {
            let (map, extractor, spec) = match usable.take() {
                Some(usable) => usable,
                None => self.maps.usable(name).await?,
            };
            let stated_pose = stated.pose(&map)?;
            let bytes = new.bytes.clone();
            let features = FeatureSet::DescriptorOnly;
            let extraction = match permit.take() {
                Some(permit) => {
                    imaging.extract_with(permit, &extractor, bytes, spec, features).await?
                }
                None => imaging.extract(&extractor, bytes, spec, features, new.demand).await?,
            };
            imaging.metrics.observe_extraction(&extraction);
            let (pose, advice) = match (stated_pose, map.frame) {
                (Some(pose), _) => (Some(pose), Vec::new()),
                (None, CoordinateFrame::Wgs84) => pose_in(&facts),
                (None, CoordinateFrame::Metric) => (None, Vec::new()),
            };
            let image = Image {
                id: stated.id.clone().unwrap_or_else(|| ImageId::from_digest(&digest)),
                digest,
                pose,
                captured_at: stated.captured_at,
                tags: stated.tags.clone(),
                media_type: extraction.media_type,
                width: extraction.width,
                height: extraction.height,
                created_at: Timestamp::now(),
            };
            if pin.is_none() {
                pin = Some(self.blobs.put_blob(digest, new.bytes.clone()).await?);
            }
            let (descriptor, recording) = (extraction.descriptor, stated.recording);
            match self.maps.store.add_recorded(&map, image, descriptor, recording).await {
                // A reindex ended meanwhile, so the descriptor is of the model before it; or the coordinate
                // frame has changed.
                Err(StoreError::Superseded(_)) if retries > 0 => retries -= 1,
                added => {
                    let mut warnings = extraction.warnings;
                    return match added? {
                        Added::Created(image) => {
                            warnings.extend(advice);
                            Ok((ImageAnswer { image, changed: Vec::new(), warnings }, true))
                        }
                        Added::Present(image) => {
                            let answer = self.restate(name, &image.id, &stated).await?;
                            // A pose that was corrected needs no advice.
                            if answer.image.pose.is_none() {
                                warnings.extend(advice);
                            }
                            Ok((ImageAnswer { warnings, ..answer }, false))
                        }
                    };
                }
            }
        }
    }

    /// Answers for an image that the map has with the same bytes, whose descriptor is known. Returns `None` if it was
    /// deleted meanwhile.
    async fn present(
        &self,
        map: &Map,
        id: &ImageId,
        stated: &StatedMeta,
        bytes: &Bytes,
        facts: &PictureFacts,
    ) -> Result<Option<ImageAnswer>, ServiceError> {
        // The store may have lost the bytes. The pin keeps them until the record is seen to be there.
        let _pin = self.blobs.put_blob(facts.digest, bytes.clone()).await?;
        let mut answer = match self.restate(&map.name, id, stated).await {
            Err(error) if error.kind == ErrorKind::NotFound => return Ok(None),
            answer => answer?,
        };
        // A pose that was corrected needs no advice.
        if answer.image.pose.is_none() && map.frame == CoordinateFrame::Wgs84 {
            answer.warnings = pose_in(facts).1;
        }
        Ok(Some(answer))
    }

    /// Returns an image without its bytes.
    pub async fn get(&self, map: &MapName, id: &ImageId) -> Result<Image, ServiceError> {
        let map = self.maps.find(map).await?;
        self.maps.store.image(&map, id).await?.ok_or_else(|| no_image(&map.name, id))
    }

    /// Returns a page of images, in the order of their ids.
    pub async fn list(
        &self,
        map: &MapName,
        cursor: Option<&ImageId>,
        limit: Option<usize>,
    ) -> Result<ImagePage, ServiceError> {
        let limit = page_size(limit)?;
        let map = self.maps.find(map).await?;
        let mut images = self.maps.store.images(&map, cursor, limit + 1).await?;
        let next_cursor = (images.len() > limit)
            .then(|| images.get(limit - 1).map(|image| image.id.to_string()))
            .flatten();
        images.truncate(limit);
        Ok(ImagePage { images, next_cursor, matches: None, unread: None })
    }

    /// Returns the bytes of an image as they were uploaded, or as a JPEG whose longer edge is at most `max_edge`
    /// pixels.
    pub async fn content(
        &self,
        map: &MapName,
        id: &ImageId,
        max_edge: Option<u32>,
    ) -> Result<(MediaType, Bytes), ServiceError> {
        let image = self.get(map, id).await?;
        let bytes = self.blobs.blob(&image.digest).await?.ok_or_else(|| {
            ServiceError::new(
                ErrorKind::Internal,
                format!("the bytes of {id} ({}) are missing from the store", image.digest),
            )
        })?;
        self.maps.imaging.thumbnail(image.media_type, bytes, max_edge).await
    }

    /// Deletes an image.
    pub async fn delete(&self, map: &MapName, id: &ImageId) -> Result<(), ServiceError> {
        let map = self.maps.find(map).await?;
        match self.maps.store.delete_image(&map, id).await? {
            true => Ok(()),
            false => Err(no_image(&map.name, id)),
        }
    }
}

/// What the caller states of an image. The pose is validated against the map.
pub(super) struct StatedMeta {
    pub id: Option<ImageId>,
    pose: Option<PoseInput>,
    captured_at: Option<Timestamp>,
    tags: Vec<String>,
    recording: Option<Recording>,
}

impl StatedMeta {
    pub fn new(meta: ImageMeta) -> Result<Self, ServiceError> {
        let ImageMeta { id, pose, captured_at, tags, recording } = meta;
        check_tags(&tags)?;
        let id = id.map(|id| id.parse()).transpose()?;
        Ok(Self { id, pose, captured_at, tags, recording })
    }

    pub fn pose(&self, map: &Map) -> Result<Option<Pose>, ServiceError> {
        Ok(self.pose.map(|pose| pose.check(map.frame)).transpose()?)
    }

    /// Returns a stored image with what is stated of it; the rest stays.
    pub fn stated_of(&self, image: &Image, map: &Map) -> Result<Image, ServiceError> {
        Ok(Image {
            pose: self.pose(map)?.or(image.pose),
            captured_at: self.captured_at.or(image.captured_at),
            tags: if self.tags.is_empty() { image.tags.clone() } else { self.tags.clone() },
            ..image.clone()
        })
    }
}

/// The position in the metadata of a picture, and what was not taken of it.
fn pose_in(facts: &PictureFacts) -> (Option<Pose>, Vec<String>) {
    let GpsReading { pose, warnings } = facts.gps.clone();
    (pose.map(Pose::Geographic), warnings)
}

pub(super) fn check_tags(tags: &[String]) -> Result<(), ServiceError> {
    let invalid = |tag: &String| tag.is_empty() || tag.chars().count() > 64;
    match tags.len() > 32 || tags.iter().any(invalid) {
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

pub(super) fn no_image(map: &MapName, id: &ImageId) -> ServiceError {
    ServiceError::not_found(format!("there is no image {:?} in the map {map}", id.as_str()))
}
