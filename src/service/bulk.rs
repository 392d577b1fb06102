//! Bulk uploads: stores a stream of images, several at a time. How a request is split into images is for the
//! server.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{Stream, StreamExt, future};
use serde::{Deserialize, Serialize};
use tokio::sync::OwnedSemaphorePermit;
use tokio_util::sync::CancellationToken;

use super::{Images, NewImage, Principal, ServiceError, StoredImage};
use whereabouts_api::{ErrorKind, ImageMeta};
use whereabouts_core::{ImageId, MapName};
use whereabouts_vision::{AdmissionRequest, WorkClass};

/// Bounds of bulk uploads.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BulkSettings {
    /// Images of one upload that are processed at a time; enough to keep decoding and inference busy.
    pub in_flight: usize,
    /// Longest time that an image is retried while the admission queue is full, in seconds.
    pub patience_s: u64,
    /// Maximum number of images in one upload.
    pub max_images: usize,
    /// Memory budget for the images of all uploads, in bytes.
    pub memory_bytes: usize,
}

/// An image of an upload.
#[derive(Debug)]
pub struct BulkImage {
    /// Its bytes, in any format of [`MediaType`](whereabouts_core::MediaType).
    pub bytes: Bytes,
    /// Its id, pose, time and tags.
    pub meta: ImageMeta,
    /// Its share of the memory budget, released when it is stored.
    pub memory: Option<OwnedSemaphorePermit>,
}

/// The result of one image of an upload: the stored image, or the id that the caller gave it, if any, and the
/// error.
pub type BulkResult = Result<StoredImage, (Option<ImageId>, ServiceError)>;

impl Images {
    /// Stores images as they arrive and returns their results in the same order. The error of one image does not
    /// affect the others. The upload ends with the first image over the maximum, with an error of the stream, or
    /// when `until` ends; images that were read before that are still stored.
    pub async fn add_many<E, O>(
        &self,
        map: &MapName,
        caller: &Principal,
        images: impl Stream<Item = Result<Result<BulkImage, ServiceError>, E>> + Send,
        until: impl Future<Output = O> + Send,
    ) -> Result<Vec<BulkResult>, E> {
        let BulkSettings { in_flight, max_images, .. } = self.bulk;
        let mut stream_error = None;
        // The last image so far of each id, and when it is done: images of one id are stored in order, so that
        // the first wins.
        let mut last_of: HashMap<ImageId, CancellationToken> = HashMap::new();
        let until_error = images.scan((), |(), next| {
            future::ready(next.map_err(|error| stream_error = Some(error)).ok())
        });
        let results = until_error
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
                    // Each image counts as a request of the key; the first was counted with the upload.
                    if index > 0 {
                        let counted = self.keys.limits.take_extra_request(caller).await;
                        counted.map_err(|error| (id.clone(), error))?;
                    }
                    self.add_when_admitted(map, image).await.map_err(|error| (id, error))
                }
            })
            .buffered(in_flight)
            .collect()
            .await;
        stream_error.map_or(Ok(results), Err)
    }

    /// Parses the id that the caller gave an image, and enforces the maximum number of images.
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
                 another upload"
            );
            return Err((id, ServiceError::new(ErrorKind::TooLarge, detail)));
        }
        Ok((image, id))
    }

    /// Stores an image, and retries while the admission queue is full.
    async fn add_when_admitted(
        &self,
        map: &MapName,
        image: BulkImage,
    ) -> Result<StoredImage, ServiceError> {
        const MAX_PAUSE: Duration = Duration::from_secs(1);
        let demand = AdmissionRequest { class: WorkClass::Index, deadline: None };
        let until = Instant::now() + Duration::from_secs(self.bulk.patience_s);
        loop {
            let new = NewImage { bytes: image.bytes.clone(), meta: image.meta.clone(), demand };
            match self.add(map, new).await {
                Err(error) if error.kind == ErrorKind::Overloaded && Instant::now() < until => {
                    tokio::time::sleep(error.retry_after.unwrap_or(MAX_PAUSE).min(MAX_PAUSE)).await;
                }
                added => return added,
            }
        }
    }
}
