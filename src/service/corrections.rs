//! Corrections of stored images: their pose, time and tags change, their bytes and descriptors stay.

use super::images::{Images, StatedMeta, check_tags, no_image};
use super::{SUPERSEDED_RETRIES, ServiceError};
use whereabouts_api::{ErrorKind, ImageAnswer, ImagePatch};
use whereabouts_core::{Image, ImageId, Map, MapName};
use whereabouts_store::StoreError;

/// How often a correction is computed again because another request changed the same image meanwhile.
const RETRIES: usize = 16;

impl Images {
    /// Changes the pose, time or tags of an image as a JSON merge patch.
    pub async fn update(
        &self,
        map: &MapName,
        id: &ImageId,
        patch: &ImagePatch,
    ) -> Result<ImageAnswer, ServiceError> {
        self.correct(map, id, |image, map| patched(image, patch, map)).await
    }

    /// Changes what the caller stated of an image that is stored already. What it did not state stays.
    pub(super) async fn restate(
        &self,
        map: &MapName,
        id: &ImageId,
        meta: &StatedMeta,
    ) -> Result<ImageAnswer, ServiceError> {
        self.correct(map, id, |image, map| meta.stated_of(image, map)).await
    }

    async fn correct(
        &self,
        name: &MapName,
        id: &ImageId,
        corrected: impl Fn(&Image, &Map) -> Result<Image, ServiceError>,
    ) -> Result<ImageAnswer, ServiceError> {
        let mut superseded = SUPERSEDED_RETRIES;
        for _ in 0..RETRIES {
            let map = self.maps.find(name).await?;
            let image = self.maps.store.image(&map, id).await?;
            let image = image.ok_or_else(|| no_image(name, id))?;
            let next = corrected(&image, &map)?;
            let changed = next.differences(&image);
            if changed.is_empty() {
                return Ok(ImageAnswer { image, changed, warnings: Vec::new() });
            }
            match self.maps.store.replace_image(&map, &image, next.clone()).await {
                Ok(true) => {
                    return Ok(ImageAnswer { image: next, changed, warnings: Vec::new() });
                }
                Ok(false) => {}
                // The coordinate frame of the map was changed meanwhile.
                Err(StoreError::Superseded(_)) if superseded > 0 => superseded -= 1,
                Err(error) => return Err(error.into()),
            }
        }
        Err(ServiceError::new(
            ErrorKind::Conflict,
            format!("other requests are changing the image {:?}; try again", id.as_str()),
        ))
    }
}

fn patched(image: &Image, patch: &ImagePatch, map: &Map) -> Result<Image, ServiceError> {
    let pose = match &patch.pose {
        None => image.pose,
        Some(None) => None,
        Some(Some(change)) => Some(change.applied_to(image.pose).check(map.frame)?),
    };
    let tags = match &patch.tags {
        None => image.tags.clone(),
        Some(tags) => tags.clone().unwrap_or_default(),
    };
    check_tags(&tags)?;
    let captured_at = patch.captured_at.unwrap_or(image.captured_at);
    Ok(Image { pose, captured_at, tags, ..image.clone() })
}
