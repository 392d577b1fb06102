//! `/maps/{map}/images:batch`: many images in one request.

mod archive;
mod form;

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use axum::body::Body;
use axum::extract::{Request, State};
use axum::{Extension, Json};
use futures_util::{Stream, StreamExt};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use utoipa::ToSchema;

use super::body::{Segments, content_type, object};
use super::maps::map_name;
use super::state::AppState;
use crate::gate::{BodyPaused, GateSettings, Problem, Ready, no_bulk_memory, too_large};
use whereabouts_api::{BatchAnswer, BatchOutcome, BatchProblem, BatchResult};
use whereabouts_api::{ErrorKind, ImageAnswer, ImageMeta};
use whereabouts_service::{BulkItem, BulkResult, Deadline, Principal, ServiceError};

/// Largest `meta` of an image, in bytes.
const LARGEST_META: usize = 64 << 10;

/// The images of a request in order, each with its number. A problem with the request ends it.
type Images = Pin<Box<dyn Stream<Item = Result<(usize, BulkItem), Problem>> + Send>>;

/// Most bytes around an image: names, headers of parts, and padding.
const OVERHEAD: usize = 1 << 20;

/// Memory reserved at first for an image whose size is not known in advance, in bytes; few images are larger.
const FIRST_RESERVATION: usize = 4 << 20;

/// Reserves memory for the images of a request, and bounds what is read between them.
#[derive(Clone)]
struct Room {
    settings: Arc<GateSettings>,
    memory: Arc<Semaphore>,
    /// Maximum size of the descriptions of an archive whose pictures have not arrived, in bytes.
    meta_bytes: usize,
    /// Bytes the reader may still receive before it must make progress.
    allowance: Arc<AtomicUsize>,
}

impl Room {
    fn is_too_small(&self, bytes: usize) -> bool {
        bytes > self.settings.server.body_limit_bytes
    }

    fn too_large(&self) -> ServiceError {
        ServiceError::new(ErrorKind::TooLarge, too_large(self.settings.server.body_limit_bytes))
    }

    /// Reserves `bytes` of the memory for bulk uploads, waiting until earlier images have released them.
    async fn reserve(&self, bytes: usize) -> Result<OwnedSemaphorePermit, Problem> {
        let count = u32::try_from(bytes).unwrap_or(u32::MAX);
        let permit = Arc::clone(&self.memory).acquire_many_owned(count);
        let permit = tokio::time::timeout(self.settings.server.request_timeout, permit).await;
        permit.ok().and_then(Result::ok).ok_or_else(no_bulk_memory)
    }

    /// Notes that the reader made progress, and that an image of `bytes` may follow.
    fn allow(&self, bytes: usize) {
        self.allowance.store(bytes.saturating_add(OVERHEAD), Ordering::Relaxed);
    }

    /// Ends a body with an error when its reader makes no progress.
    fn over(&self, body: Body) -> Body {
        self.allow(0);
        let allowance = Arc::clone(&self.allowance);
        let bounded = body.into_data_stream().map(move |chunk| {
            let chunk = chunk?;
            let consume = |allowed: usize| allowed.checked_sub(chunk.len());
            match allowance.fetch_update(Ordering::Relaxed, Ordering::Relaxed, consume) {
                Ok(_) => Ok(chunk),
                Err(_) => Err(axum::Error::new(Endless)),
            }
        });
        Body::from_stream(bounded)
    }
}

/// The error of a body in which no image ends.
#[derive(Debug, thiserror::Error)]
#[error(
    "there is more than {OVERHEAD} bytes of it between two images; is it a form, or an archive of pictures?"
)]
struct Endless;

/// The form of many images.
#[derive(ToSchema)]
#[expect(dead_code, reason = "describes the form; the body is read part by part")]
struct BatchForm {
    /// What is known about the image that follows.
    meta: Option<Vec<ImageMeta>>,
    /// The pictures. A file name is the id of an image that `meta` gives none.
    #[schema(value_type = Vec<String>, format = Binary)]
    image: Vec<Vec<u8>>,
}

/// Add many images
///
/// Send a form with a part `image` for each picture, preceded by a part `meta` (JSON) if something is known
/// about it; or a tar archive of pictures, plain or compressed with gzip, in which `a.jpg.json` says what is known
/// about `a.jpg`, wherever in the archive it is. An image whose `meta` has no id gets its file name as id. An image
/// that is stored already gets the pose, time and tags of its `meta`; `changed` names them. Links, hidden files of
/// macOS and the like are skipped, each with its own result. Several images are processed at a time. The request as a
/// whole is not bounded, only each image (`server.body_limit_bytes`) and their number (`bulk.max_images`). An error of
/// one image does not affect the others, and it is safe to send the whole request again. A problem with the request
/// itself ends it; the images before it are stored.
#[utoipa::path(post, path = "/maps/{map}/images:batch", tag = "images", params(("map" = String, Path)),
    request_body(content(
        (BatchForm = "multipart/form-data"), (Vec<u8> = "application/x-tar"),
        (Vec<u8> = "application/gzip"),
    )),
    responses(
        (status = 200, body = BatchAnswer, description = "The outcome for each image"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 408, body = Problem, description = "The body arrived too slowly", content_type = "application/problem+json"),
        (status = 415, body = Problem, description = "Neither a form nor a tar archive", content_type = "application/problem+json"),
        (status = 429, body = Problem, description = "Overloaded; Retry-After says when to try again", content_type = "application/problem+json"),
    ))]
pub(super) async fn add_images(
    State(state): State<AppState>,
    Ready(service): Ready,
    Extension(caller): Extension<Principal>,
    Segments(map): Segments<String>,
    deadline: Deadline,
    request: Request,
) -> Result<Json<BatchAnswer>, Problem> {
    let map = map_name(&map)?;
    service.maps.get(&map).await?;
    let until = service.cancelled_by(&state.gate.readiness, caller.clone(), deadline);
    let room = Room {
        settings: state.gate.settings,
        memory: state.gate.bulk_memory,
        meta_bytes: service.images.bulk.meta_bytes,
        allowance: Arc::default(),
    };
    let images = images(request, room).await?;
    let results = service.images.add_many(&map, &caller, images, until).await?;
    let results: Vec<BatchResult> = results.into_iter().map(batch_result).collect();
    let count = |of| results.iter().filter(|result| result.outcome == of).count();
    Ok(Json(BatchAnswer {
        stored: count(BatchOutcome::Stored),
        present: count(BatchOutcome::Present),
        updated: results.iter().filter(|result| !result.changed.is_empty()).count(),
        failed: count(BatchOutcome::Failed),
        skipped: count(BatchOutcome::Skipped),
        results,
    }))
}

async fn images(request: Request, room: Room) -> Result<Images, Problem> {
    let (header, media_type) = content_type(request.headers());
    let header = header.to_owned();
    if media_type == "multipart/form-data" {
        let form = form::images(request.map(|body| room.over(body)), room).await?;
        let items = form.enumerate().map(|(number, image)| {
            Ok(match image? {
                Ok(image) => (number, BulkItem::Image(image)),
                Err(error) => (number, BulkItem::Failed(error)),
            })
        });
        return Ok(Box::pin(items));
    }
    // Whatever the header says, the bytes decide.
    let (head, body) = archive::head_of(request.into_body()).await?;
    match archive::Format::of(&head) {
        Some(format) => Ok(Box::pin(archive::images(room.over(body), format, room))),
        None if archive::MEDIA_TYPES.contains(&media_type.as_str()) => {
            let what = archive::compression_of(&head).map_or_else(
                || "is not a tar archive".to_owned(),
                |name| format!("is compressed with {name}, and only gzip is read"),
            );
            Err(Problem::new(
                ErrorKind::Malformed,
                format!(
                    "the body {what}; send a tar archive (tar c *.jpg | curl --data-binary @- …)"
                ),
            ))
        }
        None => {
            let what = archive::compression_of(&head).map_or_else(
                || "neither;".to_owned(),
                |name| format!("compressed with {name}; unpack it, and"),
            );
            Err(Problem::new(
                ErrorKind::UnsupportedMedia,
                format!(
                    "the Content-Type is {header:?}, and many images are sent as a form or a tar archive, plain or \
                     compressed with gzip; the body is {what} send a form (with curl: -F image=@a.jpg -F \
                     image=@b.jpg), or an archive (tar c *.jpg | curl -H 'Content-Type: application/x-tar' \
                     --data-binary @- …)"
                ),
            ))
        }
    }
}

/// The problem behind an error of a body or its parser, which describes itself as `text`.
fn unreadable(error: &(dyn std::error::Error + 'static), text: &str) -> Problem {
    let mut causes = std::iter::successors(Some(error), |error| error.source());
    match causes.find_map(|cause| cause.downcast_ref::<BodyPaused>()) {
        Some(paused) => Problem::new(ErrorKind::TooSlow, paused.to_string()),
        None => Problem::new(ErrorKind::Malformed, format!("the body cannot be read: {text}")),
    }
}

/// Parses the `meta` of an image. The name of its file is its id, unless `meta` has one.
fn described(meta: Option<&[u8]>, name: Option<&str>) -> Result<ImageMeta, ServiceError> {
    let meta: ImageMeta = meta
        .map(object)
        .transpose()
        .map_err(|error| {
            let of = name.map(|name| format!(" of {name:?}")).unwrap_or_default();
            ServiceError::malformed(format!("the meta{of} is not the JSON expected: {error}"))
        })?
        .unwrap_or_default();
    let id = meta.id.or_else(|| name.map(str::to_owned));
    Ok(ImageMeta { id, ..meta })
}

fn batch_result(result: BulkResult) -> BatchResult {
    let (id, outcome, pose, changed, problem, warnings) = match result {
        BulkResult::Saved(answer, new) => {
            let ImageAnswer { image, changed, warnings } = *answer;
            let outcome = if new { BatchOutcome::Stored } else { BatchOutcome::Present };
            (Some(image.id.into()), outcome, image.pose, changed, None, warnings)
        }
        BulkResult::Failed(id, error) => {
            let kind = error.kind.word().to_owned();
            let retry_after_s = error.retry_after.map(|pause| pause.as_secs_f64());
            let problem = BatchProblem { kind, detail: error.detail, retry_after_s };
            (id.map(Into::into), BatchOutcome::Failed, None, Vec::new(), Some(problem), Vec::new())
        }
        BulkResult::Skipped(name, why) => {
            let detail = format!("{name:?} was skipped: {why}");
            let problem = BatchProblem { kind: "skipped".into(), detail, retry_after_s: None };
            (Some(name), BatchOutcome::Skipped, None, Vec::new(), Some(problem), Vec::new())
        }
    };
    BatchResult { id, outcome, pose, changed, problem, warnings }
}
