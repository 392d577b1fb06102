//! Many images, one after another, several of which are worked on at a time.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{Stream, StreamExt, future};
use serde::{Deserialize, Serialize};
use tokio::sync::OwnedSemaphorePermit;
use tokio_util::sync::CancellationToken;

use super::{Caller, ErrorKind, ImageMeta, NewImage, Service, ServiceError};
use crate::domain::MapName;
use crate::retrieve::{Class, Demand};
use crate::store::Added;

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
pub type BulkResult = Result<Added, (Option<String>, ServiceError)>;

impl Service {
    /// Stores images as they come; the results are in the same order. What is wrong with one image does
    /// not keep the others back. Images beyond the bound are refused one by one. An error of the stream
    /// itself ends it, when those before it are done.
    pub async fn add_images<E>(
        &self,
        map: &MapName,
        caller: &Caller,
        images: impl Stream<Item = Result<Result<BulkImage, ServiceError>, E>> + Send,
    ) -> Result<Vec<BulkResult>, E> {
        let BulkSettings { in_flight, max_images, .. } = self.settings.bulk;
        let mut broken = None;
        // The last image so far of each id, and whether it is done: of two with one id the first counts.
        let mut last_of: HashMap<String, CancellationToken> = HashMap::new();
        let whole = images
            .scan((), |(), next| future::ready(next.map_err(|error| broken = Some(error)).ok()));
        let results = whole
            .enumerate()
            .map(|(index, image)| {
                let image = image.map_err(|error| (None, error))?;
                let refuse = |error| Err((image.meta.id.clone(), error));
                if index >= max_images {
                    let detail = format!(
                        "an upload has at most {max_images} images (bulk.max_images); send the rest in another"
                    );
                    return refuse(ServiceError::new(ErrorKind::TooLarge, detail));
                }
                // Each image counts as a request of the key, of which the first is counted already.
                let counted = match index {
                    0 => Ok(()),
                    _ => self.keys.limits.take_one_more(caller),
                };
                match counted {
                    Ok(()) => Ok(image),
                    Err(error) => refuse(error),
                }
            })
            .map(|image| {
                let done = CancellationToken::new();
                let id = image.as_ref().ok().and_then(|image| image.meta.id.clone());
                let before = id.and_then(|id| last_of.insert(id, done.clone()));
                async move {
                    let _done = done.drop_guard();
                    if let Some(before) = before {
                        before.cancelled().await;
                    }
                    self.add_patiently(map, image?).await
                }
            })
            .buffered(in_flight)
            .collect()
            .await;
        broken.map_or(Ok(results), Err)
    }

    /// Stores an image when there is room for it.
    async fn add_patiently(&self, map: &MapName, image: BulkImage) -> BulkResult {
        const LONGEST: Duration = Duration::from_secs(1);
        let id = image.meta.id.clone();
        let demand = Demand { class: Class::Index, deadline: None };
        let until = Instant::now() + Duration::from_secs(self.settings.bulk.patience_s);
        loop {
            let new = NewImage { bytes: image.bytes.clone(), meta: image.meta.clone(), demand };
            match self.add_image(map, new).await {
                Err(error) if error.kind == ErrorKind::Overloaded && Instant::now() < until => {
                    tokio::time::sleep(error.retry_after.unwrap_or(LONGEST).min(LONGEST)).await;
                }
                added => return added.map_err(|error| (id, error)),
            }
        }
    }
}
