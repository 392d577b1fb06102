//! Many images, one after another, several of which are worked on at a time.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{Stream, StreamExt, future};
use serde::{Deserialize, Serialize};
use tokio::sync::OwnedSemaphorePermit;
use tokio_util::sync::CancellationToken;

use super::{Images, NewImage, Principal, ServiceError};
use whereabouts_api::{ErrorKind, ImageMeta};
use whereabouts_core::{ImageId, MapName};
use whereabouts_store::Added;
use whereabouts_vision::{AdmissionRequest, WorkClass};

/// Bounds of bulk uploads.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BulkSettings {
    /// Images of one upload that are worked on at a time: as many as keep decoding and inference busy.
    pub in_flight: usize,
    /// How long an image waits while frames and other images leave no room for it, in seconds.
    pub patience_s: u64,
    /// The most images in one upload.
    pub max_images: usize,
    /// The most memory for the images of all uploads, in bytes.
    pub memory_bytes: usize,
}

/// An image of an upload.
#[derive(Debug)]
pub struct BulkImage {
    /// Its bytes: JPEG, PNG or WebP.
    pub bytes: Bytes,
    /// What the caller says about it.
    pub meta: ImageMeta,
    /// The memory that it takes, which is given back when it is stored.
    pub memory: Option<OwnedSemaphorePermit>,
}

/// What became of an image of an upload: it is stored, or why not, with its id if the caller gave one.
pub type BulkResult = Result<Added, (Option<ImageId>, ServiceError)>;

impl Images {
    /// Stores images as they come; the results are in the same order. What is wrong with one image does
    /// not keep the others back. An upload ends with the first image beyond the bound, with an error of the
    /// stream itself, or when `until` does; those before are then done.
    pub async fn add_many<E, O>(
        &self,
        map: &MapName,
        caller: &Principal,
        images: impl Stream<Item = Result<Result<BulkImage, ServiceError>, E>> + Send,
        until: impl Future<Output = O> + Send,
    ) -> Result<Vec<BulkResult>, E> {
        let BulkSettings { in_flight, max_images, .. } = self.bulk;
        let mut broken = None;
        // The last image so far of each id, and whether it is done: of two with one id the first counts.
        let mut last_of: HashMap<ImageId, CancellationToken> = HashMap::new();
        let whole = images
            .scan((), |(), next| future::ready(next.map_err(|error| broken = Some(error)).ok()));
        let results = whole
            .take_until(Box::pin(until))
            .take(max_images + 1)
            .enumerate()
            .map(|(index, image)| (index, self.checked(index, image)))
            .map(|(index, image)| {
                let done = CancellationToken::new();
                let id = image.as_ref().ok().and_then(|(_, id)| id.clone());
                let before = id.and_then(|id| last_of.insert(id, done.clone()));
                async move {
                    let _done = done.drop_guard();
                    if let Some(before) = before {
                        before.cancelled().await;
                    }
                    let (image, id) = image?;
                    // Each image counts as a request of the key, of which the first is counted already.
                    if index > 0 {
                        let counted = self.keys.limits.take_one_more(caller).await;
                        counted.map_err(|error| (id.clone(), error))?;
                    }
                    self.add_patiently(map, image).await.map_err(|error| (id, error))
                }
            })
            .buffered(in_flight)
            .collect()
            .await;
        broken.map_or(Ok(results), Err)
    }

    /// An image with the id that the caller gave it, if it is to be stored.
    fn checked(
        &self,
        index: usize,
        image: Result<BulkImage, ServiceError>,
    ) -> Result<(BulkImage, Option<ImageId>), (Option<ImageId>, ServiceError)> {
        let image = image.map_err(|error| (None, error))?;
        let id = image.meta.id.as_deref().map(str::parse::<ImageId>).transpose();
        let id = id.map_err(|error| (None, error.into()))?;
        let max_images = self.bulk.max_images;
        if index >= max_images {
            let detail = format!(
                "an upload has at most {max_images} images (bulk.max_images); send this one and the rest in \
                 another"
            );
            return Err((id, ServiceError::new(ErrorKind::TooLarge, detail)));
        }
        Ok((image, id))
    }

    /// Stores an image when there is room for it.
    async fn add_patiently(&self, map: &MapName, image: BulkImage) -> Result<Added, ServiceError> {
        const LONGEST: Duration = Duration::from_secs(1);
        let demand = AdmissionRequest { class: WorkClass::Index, deadline: None };
        let until = Instant::now() + Duration::from_secs(self.bulk.patience_s);
        loop {
            let new = NewImage { bytes: image.bytes.clone(), meta: image.meta.clone(), demand };
            match self.add(map, new).await {
                Err(error) if error.kind == ErrorKind::Overloaded && Instant::now() < until => {
                    tokio::time::sleep(error.retry_after.unwrap_or(LONGEST).min(LONGEST)).await;
                }
                added => return added,
            }
        }
    }
}
