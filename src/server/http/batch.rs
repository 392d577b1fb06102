//! `/maps/{map}/images:batch`: many images in one request.

mod archive;
mod form;

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use axum::extract::{Request, State};
use axum::{Extension, Json};
use bytes::Bytes;
use futures_util::{Stream, StreamExt, stream};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use utoipa::ToSchema;

use super::body::{Segments, content_type};
use super::guard::{discard, too_large};
use super::maps::map_name;
use super::messages::no_bulk_memory;
use super::problem::Problem;
use super::state::{AppState, HttpSettings, Ready};
use whereabouts_api::{BatchAnswer, BatchOutcome, BatchProblem, BatchResult};
use whereabouts_api::{ErrorKind, ImageMeta};
use whereabouts_service::{BulkImage, BulkResult, Deadline, Principal, ServiceError};
use whereabouts_store::Added;

/// The route.
pub(super) const PATH: &str = "/maps/{map}/images:batch";

/// The largest description of an image, in bytes.
const LARGEST_META: usize = 64 << 10;

/// The images of a request, each as it came in or why it cannot be stored; the first problem ends it.
type Images = Pin<Box<dyn Stream<Item = Result<Result<BulkImage, ServiceError>, Problem>> + Send>>;

/// What an image may come to without getting any further, in bytes: names, heads of parts, and what lies between.
const ASIDE: usize = 1 << 20;

/// The largest first step of an image whose size is not known before, in bytes; few are larger.
const STEP: usize = 4 << 20;

/// The room that there is for an image that comes in.
#[derive(Clone)]
struct Room {
    settings: Arc<HttpSettings>,
    memory: Arc<Semaphore>,
    /// How many bytes of the body may still come before whoever reads it gets on.
    allowance: Arc<AtomicUsize>,
}

impl Room {
    fn is_too_small(&self, bytes: usize) -> bool {
        bytes > self.settings.body_limit_bytes
    }

    fn too_large(&self) -> ServiceError {
        ServiceError::new(ErrorKind::TooLarge, too_large(self.settings.body_limit_bytes))
    }

    /// So many bytes of the memory for bulk uploads, once images before this one have given them back.
    async fn take(&self, bytes: usize) -> Result<OwnedSemaphorePermit, Problem> {
        let count = u32::try_from(bytes).unwrap_or(u32::MAX);
        let taking = Arc::clone(&self.memory).acquire_many_owned(count);
        let taken = tokio::time::timeout(self.settings.request_timeout, taking).await;
        taken.ok().and_then(Result::ok).ok_or_else(no_bulk_memory)
    }

    /// The reader has got on: so much may come now, and what lies between.
    fn allow(&self, bytes: usize) {
        self.allowance.store(bytes.saturating_add(ASIDE), Ordering::Relaxed);
    }

    /// A body that breaks off when its reader does not get on.
    fn over(&self, body: Body) -> Body {
        self.allow(0);
        let allowance = Arc::clone(&self.allowance);
        let bounded = body.into_data_stream().map(move |chunk| {
            let chunk = chunk?;
            let take = |left: usize| left.checked_sub(chunk.len());
            match allowance.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take) {
                Ok(_) => Ok(chunk),
                Err(_) => Err(axum::Error::new(Endless)),
            }
        });
        Body::from_stream(bounded)
    }
}

/// A body in which nothing ends.
#[derive(Debug, thiserror::Error)]
#[error(
    "there is more than {ASIDE} bytes of it between two images; is it a form, or an archive of pictures?"
)]
struct Endless;

/// The form of many images.
#[derive(ToSchema)]
#[expect(dead_code, reason = "describes the form; the body is read part by part")]
struct BatchForm {
    /// What is known about the image after it.
    meta: Option<Vec<ImageMeta>>,
    /// The pictures. A file name is the id of an image that `meta` gives none.
    #[schema(value_type = Vec<String>, format = Binary)]
    image: Vec<Vec<u8>>,
}

/// Add many images
///
/// A form with a part `image` for each picture, after a part `meta` (JSON) if something is known about it; or
/// a tar archive of pictures, in which what is known about `a.jpg` is in `a.jpg.json`, right before or
/// after it. An image whose `meta` has no id has its file name as id. Several images are worked on at a time,
/// and there is no bound on the whole, only on each (`server.body_limit_bytes`) and on their number
/// (`bulk.max_images`). What is wrong with one image does not keep the others back; sending all of it again
/// is safe. A problem with the request as a whole ends it; what came before that is stored.
#[utoipa::path(post, path = "/maps/{map}/images:batch", tag = "images", params(("map" = String, Path)),
    request_body(content(
        (BatchForm = "multipart/form-data"), (Vec<u8> = "application/x-tar"),
    )),
    responses(
        (status = 200, body = BatchAnswer, description = "What became of each"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 408, body = Problem, description = "The body came too slowly", content_type = "application/problem+json"),
        (status = 415, body = Problem, description = "Neither a form nor a tar archive", content_type = "application/problem+json"),
        (status = 429, body = Problem, description = "Overloaded; Retry-After says when it will be less so", content_type = "application/problem+json"),
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
    let until = service.cancelled_by(&state.door, caller.clone(), deadline);
    let (settings, memory) = (state.settings, state.bulk_memory);
    let images = images(request, Room { settings, memory, allowance: Arc::default() }).await?;
    let results = service.images.add_many(&map, &caller, images, until).await?;
    let results: Vec<BatchResult> = results.into_iter().map(batch_result).collect();
    let count = |of| results.iter().filter(|result| result.outcome == of).count();
    Ok(Json(BatchAnswer {
        stored: count(BatchOutcome::Stored),
        present: count(BatchOutcome::Present),
        failed: count(BatchOutcome::Failed),
        results,
    }))
}

async fn images(request: Request, room: Room) -> Result<Images, Problem> {
    let (header, essence) = content_type(request.headers());
    let header = header.to_owned();
    let request = request.map(|body| room.over(body));
    match essence.as_str() {
        "multipart/form-data" => Ok(Box::pin(form::images(request, room).await?)),
        "application/x-tar" => Ok(Box::pin(archive::images(request.into_body(), room))),
        _ => Err(Problem::new(
            ErrorKind::UnsupportedMedia,
            format!(
                "the Content-Type is {header:?}; send a form (with curl: -F image=@a.jpg -F image=@b.jpg), \
                 or a tar archive (tar c *.jpg | curl -H 'Content-Type: application/x-tar' --data-binary \
                 @- …)"
            ),
        )),
    }
}

/// A body that may take any time, if nothing of it waits for long.
pub(super) fn unhurried(body: Body, pause: Duration) -> Body {
    let unhurried = Unhurried { body: Some(body.into_data_stream()), pause };
    Body::from_stream(stream::unfold(unhurried, |mut unhurried| async move {
        let next = unhurried.next().await?;
        Some((next, unhurried))
    }))
}

/// What of a body is still to come. What nobody reads is thrown away for a while, or the client, which is still
/// sending, would see a reset connection instead of the answer.
struct Unhurried {
    body: Option<BodyDataStream>,
    pause: Duration,
}

impl Unhurried {
    async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        let next = tokio::time::timeout(self.pause, self.body.as_mut()?.next()).await;
        let next = next.unwrap_or_else(|_| Some(Err(axum::Error::new(Paused(self.pause)))));
        if !matches!(next, Some(Ok(_))) {
            self.body = None;
        }
        next
    }
}

impl Drop for Unhurried {
    fn drop(&mut self) {
        if let (Some(body), Ok(runtime)) = (self.body.take(), Handle::try_current()) {
            runtime.spawn(discard(body));
        }
    }
}

/// Nothing of a body came for so long.
#[derive(Debug, thiserror::Error)]
#[error(
    "nothing of the body came for {} s (server.body_pause_s); send it again, what was stored is left as it is",
    .0.as_secs()
)]
struct Paused(Duration);

/// What an error of a body or its reader means, whose own words for it are these.
fn unreadable(error: &(dyn std::error::Error + 'static), words: &str) -> Problem {
    let mut causes = std::iter::successors(Some(error), |error| error.source());
    match causes.find_map(|cause| cause.downcast_ref::<Paused>()) {
        Some(paused) => Problem::new(ErrorKind::TooSlow, paused.to_string()),
        None => Problem::new(ErrorKind::Malformed, format!("the body cannot be read: {words}")),
    }
}

/// What a caller says about an image; its name is its id unless that says otherwise.
fn described(meta: Option<&[u8]>, name: Option<&str>) -> Result<ImageMeta, ServiceError> {
    let meta: ImageMeta = meta
        .map(serde_json::from_slice)
        .transpose()
        .map_err(|error| {
            let of = name.map(|name| format!(" of {name:?}")).unwrap_or_default();
            ServiceError::malformed(format!("what is said{of} is not the JSON expected: {error}"))
        })?
        .unwrap_or_default();
    let id = meta.id.or_else(|| name.map(str::to_owned));
    Ok(ImageMeta { id, ..meta })
}

fn batch_result(result: BulkResult) -> BatchResult {
    let (id, outcome, problem) = match result {
        Ok(Added::Created(image)) => (Some(image.id.into()), BatchOutcome::Stored, None),
        Ok(Added::Present(image)) => (Some(image.id.into()), BatchOutcome::Present, None),
        Err((id, error)) => {
            let kind = error.kind.word().to_owned();
            let retry_after_s = error.retry_after.map(|pause| pause.as_secs_f64());
            let problem = BatchProblem { kind, detail: error.detail, retry_after_s };
            (id.map(Into::into), BatchOutcome::Failed, Some(problem))
        }
    };
    BatchResult { id, outcome, problem }
}
