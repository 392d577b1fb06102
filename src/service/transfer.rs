//! Maps that come from another store or go there, with the descriptors that their images have.

use bytes::Bytes;
use uuid::Uuid;

use super::images::{check_tags, page_size};
use super::{SUPERSEDED, Service, ServiceError};
use whereabouts_api::{ErrorKind, ExportPage, ImportedImage, MapState};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, Image, ImageId, Map, MapName, MediaType};
use whereabouts_store::{Added, StoreError};
use whereabouts_vision::{AdmissionRequest, FeatureSet};

/// The most numbers in a descriptor that comes from elsewhere.
const MAX_DIM: usize = 1 << 16;

impl Service {
    /// Images of a map with their descriptors, a page at a time.
    pub async fn export(
        &self,
        name: &MapName,
        cursor: Option<&ImageId>,
        limit: Option<usize>,
    ) -> Result<ExportPage, ServiceError> {
        let limit = page_size(limit)?;
        let mut left = SUPERSEDED;
        loop {
            let map = self.known_map(name).await?;
            let mut images = match self.exports.export(&map, cursor, limit + 1).await {
                Err(StoreError::Superseded(_)) if left > 0 => {
                    left -= 1;
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

    /// Makes a map like one of another store, or finds that it is there; also says whether it is new.
    /// Its model need not be installed.
    pub async fn import_map(
        &self,
        name: &MapName,
        from: Map,
    ) -> Result<(MapState, bool), ServiceError> {
        check_map(&from)?;
        let mut left = SUPERSEDED;
        loop {
            let known = self.maps.map(name).await?;
            let revision = match &known {
                Some(known) if fits(known, &from) => {
                    return Ok((self.state_of(name).await?, false));
                }
                Some(known) if self.maps.index_state(known).await?.images > 0 => {
                    return Err(unlike(known, &from));
                }
                Some(known) => known.revision,
                None => 0,
            };
            let wanted = Map { uid: Uuid::now_v7(), name: name.clone(), revision, ..from.clone() };
            match self.maps.put_map(wanted).await {
                Err(StoreError::Superseded(_)) if left > 0 => left -= 1,
                put => {
                    let (_, new) = put?;
                    return Ok((self.state_of(name).await?, new));
                }
            }
        }
    }

    /// Stores an image with the descriptor that it has elsewhere.
    pub async fn import_image(
        &self,
        name: &MapName,
        from: ImportedImage,
        bytes: Bytes,
        demand: AdmissionRequest,
    ) -> Result<Added, ServiceError> {
        let ImportedImage { map: source, image: ExportedImage { image, descriptor } } = from;
        let map = self.known_map(name).await?;
        if !fits(&map, &source) {
            return Err(unlike(&map, &source));
        }
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
                let (_, extractor) = self.usable_map(name).await?;
                let (bytes, features) = (bytes.clone(), FeatureSet::DescriptorOnly);
                self.extract(&extractor, bytes, map.descriptor, features, demand).await?.descriptor
            }
        };
        let _pin = self.blobs.put_blob(image.digest, bytes).await?;
        // Superseded, if it was reindexed since it was looked up: its descriptors are of another model.
        Ok(self.maps.add_image(&map, image, descriptor).await?)
    }
}

fn fits(map: &Map, from: &Map) -> bool {
    map.is_compatible_with(from) && map.frame == from.frame
}

fn unlike(map: &Map, from: &Map) -> ServiceError {
    let said = |map: &Map| {
        format!(
            "{} ({}, {}, {} precision, {} frame)",
            map.model, map.model_digest, map.descriptor, map.precision, map.frame
        )
    };
    ServiceError::new(
        ErrorKind::Conflict,
        format!(
            "the map {} has images whose descriptors are of {}, but these are of {}: restore under \
             another name, or remove that map first",
            map.name,
            said(map),
            said(from)
        ),
    )
}

fn check_map(map: &Map) -> Result<(), ServiceError> {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    let model = &map.model;
    if !(1..=64).contains(&model.len()) || !model.bytes().all(plain) || model.starts_with('.') {
        return Err(ServiceError::unprocessable(format!(
            "{:?} cannot be the name of a model",
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

fn check_image(image: &Image, map: &Map, bytes: &Bytes) -> Result<(), ServiceError> {
    let refuse = |why: &str| {
        let id = image.id.as_str();
        Err(ServiceError::unprocessable(format!("the image {id:?} is refused: {why}")))
    };
    if Digest::of(bytes) != image.digest {
        return refuse("its bytes are not those of its digest");
    }
    if MediaType::sniff(bytes) != Some(image.media_type) {
        return refuse("its bytes are not of its media type");
    }
    check_tags(&image.tags)?;
    match image.pose.map(|pose| pose.checked()) {
        Some(Err(error)) => refuse(&error.to_string()),
        Some(Ok(pose)) if pose.frame() != map.frame => refuse("its pose is of another frame"),
        _ => Ok(()),
    }
}
