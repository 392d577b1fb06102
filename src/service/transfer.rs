//! Export and import: copies maps between stores with their descriptors, so that no image is extracted again.
//! Archives and their progress are for the client.

use std::sync::Arc;

use bytes::Bytes;
use uuid::Uuid;

use super::images::{check_tags, page_size};
use super::{Maps, SUPERSEDED_RETRIES, ServiceError};
use whereabouts_api::{
    ErrorKind, ExportPage, ImportedImage, ImportedMap, MapState, VocabularyData,
};
use whereabouts_core::{
    Digest, ExportedImage, Image, ImageId, Map, MapName, MapVocabulary, MediaType,
};
use whereabouts_store::{Added, BlobStore, ExportStore, StoreError, TextStore};
use whereabouts_vision::{AdmissionRequest, FeatureSet};

/// Maximum dimension of an imported descriptor.
const MAX_DIM: usize = 1 << 16;

/// Copies maps between stores with their descriptors.
pub struct Transfer {
    /// The maps.
    pub maps: Maps,
    /// Images with their descriptors.
    pub exports: Arc<dyn ExportStore>,
    /// The bytes of the images.
    pub blobs: Arc<dyn BlobStore>,
    /// What was read in the images.
    pub texts: Arc<dyn TextStore>,
}

impl Transfer {
    /// Returns a page of the images of a map with their descriptors.
    pub async fn export(
        &self,
        name: &MapName,
        cursor: Option<&ImageId>,
        limit: Option<usize>,
    ) -> Result<ExportPage, ServiceError> {
        let limit = page_size(limit)?;
        let mut retries = SUPERSEDED_RETRIES;
        loop {
            let map = self.maps.find(name).await?;
            let mut images = match self.exports.export(&map, cursor, limit + 1).await {
                Err(StoreError::Superseded(_)) if retries > 0 => {
                    retries -= 1;
                    continue;
                }
                images => images?,
            };
            let more = images.len() > limit;
            images.truncate(limit);
            let next_cursor = images.last().filter(|_| more).map(|last| last.image.id.to_string());
            return Ok(ExportPage { map, images, next_cursor });
        }
    }

    /// Creates a map like one of another store, unless there is one already. Returns its state, and whether it is
    /// new. The model of the map need not be installed.
    pub async fn import_map(
        &self,
        name: &MapName,
        imported: ImportedMap,
    ) -> Result<(MapState, bool), ServiceError> {
        let ImportedMap { map: from, vocabulary_data } = imported;
        check_map(&from)?;
        let mut pin = None;
        let mut retries = SUPERSEDED_RETRIES;
        loop {
            let known = self.maps.store.map(name).await?;
            let revision = match &known {
                Some(known) if is_compatible(known, &from) => {
                    return Ok((self.maps.state_of(name).await?, false));
                }
                Some(known) if self.maps.store.index_state(known).await?.images > 0 => {
                    return Err(incompatible(known, &from));
                }
                Some(known) => known.revision,
                None => 0,
            };
            if let Some(own) = from.vocabulary
                && pin.is_none()
            {
                let bytes = vocabulary_bytes(&own, vocabulary_data.as_ref())?;
                pin = Some(self.blobs.put_blob(own.digest, bytes).await?);
            }
            let new_map = Map { uid: Uuid::now_v7(), name: name.clone(), revision, ..from.clone() };
            match self.maps.store.put_map(new_map).await {
                Err(StoreError::Superseded(_)) if retries > 0 => retries -= 1,
                put => {
                    let (_, new) = put?;
                    return Ok((self.maps.state_of(name).await?, new));
                }
            }
        }
    }

    /// Returns the bytes of the vocabulary that a map has of its own.
    pub async fn vocabulary(&self, name: &MapName) -> Result<Bytes, ServiceError> {
        let map = self.maps.find(name).await?;
        let missing = || {
            ServiceError::not_found(format!(
                "the map {name} has no vocabulary of its own; `vocabulary` of GET /maps/{name} says which it has"
            ))
        };
        let own = map.vocabulary.ok_or_else(missing)?;
        self.blobs.blob(&own.digest).await?.ok_or_else(missing)
    }

    /// Stores an image with the descriptor that it has in another store.
    pub async fn import_image(
        &self,
        name: &MapName,
        from: ImportedImage,
        bytes: Bytes,
        admission: AdmissionRequest,
    ) -> Result<Added, ServiceError> {
        let ImportedImage { map: source, image } = from;
        let ExportedImage { image, descriptor, recording, texts, .. } = image;
        let map = self.maps.find(name).await?;
        if !is_compatible(&map, &source) {
            return Err(incompatible(&map, &source));
        }
        check_digest(&image, &bytes).await?;
        check_image(&image, &map, &bytes)?;
        let descriptor = match descriptor {
            Some(descriptor) if descriptor.dim() == map.dim => descriptor,
            Some(descriptor) => {
                return Err(ServiceError::unprocessable(format!(
                    "the descriptor of the image {:?} has {} numbers, those of the map have {}",
                    image.id.as_str(),
                    descriptor.dim(),
                    map.dim
                )));
            }
            None => {
                let (_, extractor, spec) = self.maps.usable(name).await?;
                let (bytes, features) = (bytes.clone(), FeatureSet::DescriptorOnly);
                let imaging = &self.maps.imaging;
                imaging.extract(&extractor, bytes, spec, features, admission).await?.descriptor
            }
        };
        let _pin = self.blobs.put_blob(image.digest, bytes).await?;
        // Not retried if the map was reindexed meanwhile: its descriptors are now of another model than this one.
        let added = self.maps.store.add_recorded(&map, image, descriptor, recording).await?;
        // Those of an image that is there already stay.
        if let (Added::Created(image), Some(texts)) = (&added, texts) {
            self.texts.put_texts(&map, image, texts).await?;
        }
        Ok(added)
    }
}

/// The bytes of an imported vocabulary, if they are those that the record names.
fn vocabulary_bytes(
    own: &MapVocabulary,
    data: Option<&VocabularyData>,
) -> Result<Bytes, ServiceError> {
    let detail = match data {
        Some(data) if Digest::of(&data.0) == own.digest => return Ok(data.0.clone()),
        Some(_) => "vocabulary_data does not match the digest of the map's vocabulary",
        None => {
            "the map has a vocabulary of its own; send its bytes (GET /maps/{map}/vocabulary of the other server) \
             as vocabulary_data in base64"
        }
    };
    Err(ServiceError::unprocessable(detail))
}

fn is_compatible(map: &Map, from: &Map) -> bool {
    map.is_compatible_with(from) && map.frame == from.frame
}

fn incompatible(map: &Map, from: &Map) -> ServiceError {
    let shown = |map: &Map| {
        format!(
            "{} ({}, {}, {} precision, {} frame)",
            map.model, map.model_digest, map.descriptor, map.precision, map.frame
        )
    };
    ServiceError::new(
        ErrorKind::Conflict,
        format!(
            "the map {} has images whose descriptors are of {}, but these are of {}: restore under \
             another name, or delete that map first",
            map.name,
            shown(map),
            shown(from)
        ),
    )
}

fn check_map(map: &Map) -> Result<(), ServiceError> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    let model = &map.model;
    if !(1..=64).contains(&model.len()) || !model.bytes().all(plain) || model.starts_with('.') {
        return Err(ServiceError::unprocessable(format!(
            "{:?} is not a valid model name",
            model.chars().take(80).collect::<String>()
        )));
    }
    if !(1..=MAX_DIM).contains(&map.dim) {
        return Err(ServiceError::unprocessable(format!(
            "a descriptor has 1 to {MAX_DIM} numbers, not {}",
            map.dim
        )));
    }
    match map.description.as_ref().is_some_and(|text| text.chars().count() > 2000) {
        true => Err(ServiceError::unprocessable("the description exceeds 2,000 characters")),
        false => Ok(()),
    }
}

fn invalid_image(image: &Image, why: &str) -> ServiceError {
    let id = image.id.as_str();
    ServiceError::unprocessable(format!("the image {id:?} cannot be imported: {why}"))
}

/// Hashes the bytes of an image on a blocking thread.
async fn check_digest(image: &Image, bytes: &Bytes) -> Result<(), ServiceError> {
    let bytes = bytes.clone();
    let digest = tokio::task::spawn_blocking(move || Digest::of(&bytes))
        .await
        .map_err(|error| ServiceError::new(ErrorKind::Internal, error.to_string()))?;
    match digest == image.digest {
        true => Ok(()),
        false => Err(invalid_image(image, "its bytes do not match its digest")),
    }
}

fn check_image(image: &Image, map: &Map, bytes: &Bytes) -> Result<(), ServiceError> {
    let invalid = |why: &str| Err(invalid_image(image, why));
    if MediaType::sniff(bytes) != Some(image.media_type) {
        return invalid("its bytes do not match its media type");
    }
    check_tags(&image.tags)?;
    match image.pose.map(|pose| pose.checked()) {
        Some(Err(error)) => invalid(&error.to_string()),
        Some(Ok(pose)) if pose.frame() != map.frame => {
            invalid("its pose is in another coordinate frame than the map")
        }
        _ => Ok(()),
    }
}
