//! Bulk uploads: stores a stream of images, several at a time. How a request is split into images is for the
//! server.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{Stream, StreamExt, future};
use serde::{Deserialize, Serialize};
use tokio::sync::OwnedSemaphorePermit;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::images::StatedMeta;
use super::{Images, NewImage, Principal, ServiceError};
use whereabouts_api::{ErrorKind, ImageAnswer, ImageMeta};
use whereabouts_core::{Image, ImageId, MapName, Recording};
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
    /// Maximum size of the descriptions of one archive whose pictures have not arrived, in bytes.
    pub meta_bytes: usize,
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

/// A part of an upload.
#[derive(Debug)]
pub enum BulkItem {
    /// An image to store.
    Image(BulkImage),
    /// The id, pose, time and tags of an image that came before it, or why they cannot be read. They replace those
    /// that the image came with.
    Meta(Result<ImageMeta, ServiceError>),
    /// Something that is not an image, its name, and why it is skipped.
    Skipped(String, &'static str),
    /// Something that cannot be stored.
    Failed(ServiceError),
}

/// The result of one image of an upload.
#[derive(Debug)]
pub enum BulkResult {
    /// The stored image, and whether it is new.
    Saved(Box<ImageAnswer>, bool),
    /// The name of something that is not an image, and why it was skipped.
    Skipped(String, &'static str),
    /// The id that the caller gave the image, if any, and the error.
    Failed(Option<ImageId>, ServiceError),
}

/// Results of earlier images of an upload, by the number of their item.
type Earlier = HashMap<usize, Arc<OnceLock<SavedImage>>>;

/// An image that an upload has stored.
#[derive(Debug, Clone)]
struct SavedImage {
    answer: ImageAnswer,
    is_new: bool,
    /// Its place in the recording.
    recording: Recording,
}

impl Images {
    /// Stores images as they arrive, each item with its number, and returns the results in the order of the numbers.
    /// A [`BulkItem::Meta`] has the number of the image that it describes, and changes the result of that image. The
    /// error of one image does not affect the others. An upload is a recording, in the order of its images. It ends with the first item over the maximum, with an
    /// error of the stream, or when `until` ends; images that were read before that are still stored.
    pub async fn add_many<E, O>(
        &self,
        map: &MapName,
        caller: &Principal,
        items: impl Stream<Item = Result<(usize, BulkItem), E>> + Send,
        until: impl Future<Output = O> + Send,
    ) -> Result<Vec<BulkResult>, E> {
        let BulkSettings { in_flight, max_images, .. } = self.bulk;
        let mut stream_error = None;
        // When the last item so far of each image and of each id is done: items of one image or id are processed in
        // order, so that the first picture wins, and a description finds its image.
        let mut last_of: HashMap<ImageId, CancellationToken> = HashMap::new();
        let mut done_of: HashMap<usize, CancellationToken> = HashMap::new();
        let mut earlier = Earlier::new();
        let upload = Uuid::now_v7();
        let (mut taken, mut counted) = (0, 0);
        let until_error = items.scan((), |(), next| {
            future::ready(next.map_err(|error| stream_error = Some(error)).ok())
        });
        let results: Vec<(usize, Option<BulkResult>)> = until_error
            .take_until(Box::pin(until))
            .take_while(|(_, item)| {
                let is_within = taken <= max_images;
                taken += usize::from(!matches!(item, BulkItem::Meta(_)));
                future::ready(is_within)
            })
            .map(|(number, item)| {
                let index = counted;
                counted += usize::from(!matches!(item, BulkItem::Meta(_)));
                let recording =
                    Recording { id: upload, number: u32::try_from(index).unwrap_or(u32::MAX) };
                let item = self.checked(index, recorded(item, recording));
                let saved = Arc::clone(earlier.entry(number).or_default());
                let done = CancellationToken::new();
                let id = item.as_ref().ok().and_then(|(_, id)| id.clone());
                let of_id = id.and_then(|id| last_of.insert(id, done.clone()));
                let of_image = done_of.insert(number, done.clone());
                async move {
                    let _done = done.drop_guard();
                    for before in [of_id, of_image].into_iter().flatten() {
                        before.cancelled().await;
                    }
                    let result = match item {
                        Ok((item, id)) => {
                            let place = (index, recording);
                            self.process((map, caller), place, item, id, &saved).await
                        }
                        Err((id, error)) => Some(BulkResult::Failed(id, error)),
                    };
                    (number, result)
                }
            })
            .buffered(in_flight)
            .collect()
            .await;
        match stream_error {
            Some(error) => Err(error),
            None => {
                // A description comes after its image, and its result replaces that of the image.
                let results = results.into_iter().filter_map(|(at, result)| Some((at, result?)));
                Ok(results.collect::<BTreeMap<_, _>>().into_values().collect())
            }
        }
    }

    /// Parses the id that the caller gave an image, and enforces the maximum number of images.
    fn checked(
        &self,
        index: usize,
        item: BulkItem,
    ) -> Result<(BulkItem, Option<ImageId>), (Option<ImageId>, ServiceError)> {
        let given = match &item {
            BulkItem::Image(BulkImage { meta, .. }) | BulkItem::Meta(Ok(meta)) => {
                meta.id.as_deref()
            }
            _ => None,
        };
        let id = given.map(str::parse::<ImageId>).transpose();
        let max_images = self.bulk.max_images;
        match (id, &item) {
            (Err(error), BulkItem::Meta(_)) => Ok((BulkItem::Meta(Err(error.into())), None)),
            (Err(error), _) => Err((None, error.into())),
            (Ok(id), BulkItem::Meta(_)) => Ok((item, id)),
            (Ok(id), _) if index >= max_images => {
                let detail = format!(
                    "an upload has at most {max_images} images (bulk.max_images); send this one and the rest in \
                     another upload"
                );
                Err((id, ServiceError::new(ErrorKind::TooLarge, detail)))
            }
            (Ok(id), _) => Ok((item, id)),
        }
    }

    /// Processes an item. Returns `None` if the result of its image stays as it is.
    async fn process(
        &self,
        (map, caller): (&MapName, &Principal),
        (index, recording): (usize, Recording),
        item: BulkItem,
        id: Option<ImageId>,
        saved: &OnceLock<SavedImage>,
    ) -> Option<BulkResult> {
        let result = match item {
            BulkItem::Skipped(name, why) => return Some(BulkResult::Skipped(name, why)),
            BulkItem::Failed(error) => return Some(BulkResult::Failed(None, error)),
            BulkItem::Meta(meta) => self.describe(map, saved.get()?.clone(), meta).await,
            BulkItem::Image(image) => {
                // Each image counts as a request of the key; the first was counted with the upload.
                let within_limit = match index {
                    0 => Ok(()),
                    _ => self.keys.limits.take_extra_request(caller).await,
                };
                match within_limit {
                    Ok(()) => self.add_when_admitted(map, image).await,
                    Err(error) => Err(error),
                }
            }
        };
        Some(match result {
            Ok((answer, is_new)) => {
                let _ = saved.set(SavedImage { answer: answer.clone(), is_new, recording });
                BulkResult::Saved(Box::new(answer), is_new)
            }
            Err(error) => BulkResult::Failed(id, error),
        })
    }

    /// Gives an image of this upload the id, pose, time and tags that came after it, so that the result is the same
    /// as if they had come before it: an image that they do not allow is removed again if it is new.
    async fn describe(
        &self,
        map: &MapName,
        saved: SavedImage,
        meta: Result<ImageMeta, ServiceError>,
    ) -> Result<(ImageAnswer, bool), ServiceError> {
        let SavedImage { answer, is_new, recording } = saved;
        let ImageAnswer { image, changed, warnings } = answer;
        let described = self.described(map, &image, meta, recording).await;
        let moved = described.as_ref().is_ok_and(|(other, _)| other.image.id != image.id);
        if is_new && (described.is_err() || moved) {
            self.delete(map, &image.id).await?;
        }
        let (mut answer, is_other_new) = described?;
        if moved {
            return Ok((answer, is_other_new));
        }
        answer.warnings = warnings;
        if is_new {
            answer.changed = Vec::new();
        } else {
            answer.changed.extend(changed);
            answer.changed.sort();
            answer.changed.dedup();
        }
        Ok((answer, is_new))
    }

    async fn described(
        &self,
        map: &MapName,
        image: &Image,
        meta: Result<ImageMeta, ServiceError>,
        recording: Recording,
    ) -> Result<(ImageAnswer, bool), ServiceError> {
        let meta = meta?;
        let recording = meta.recording.or(Some(recording));
        let meta = ImageMeta { recording, ..meta };
        let stated = StatedMeta::new(meta.clone())?;
        if stated.id.as_ref().is_none_or(|id| *id == image.id) {
            return Ok((self.restate(map, &image.id, &stated).await?, false));
        }
        // It came under the name of its file, and is to have another id.
        let (_, bytes) = self.content(map, &image.id, None).await?;
        self.add_when_admitted(map, BulkImage { bytes, meta, memory: None }).await
    }

    /// Stores an image, and retries while the admission queue is full.
    async fn add_when_admitted(
        &self,
        map: &MapName,
        image: BulkImage,
    ) -> Result<(ImageAnswer, bool), ServiceError> {
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

/// An image without a place in a recording gets its place in the upload.
fn recorded(item: BulkItem, place: Recording) -> BulkItem {
    match item {
        BulkItem::Image(mut image) => {
            image.meta.recording.get_or_insert(place);
            BulkItem::Image(image)
        }
        other => other,
    }
}
