//! `/maps/{map}/images`.

use axum::Json;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::IntoResponse;
use bytes::Bytes;
use jiff::Timestamp;
use serde::Deserialize;
use utoipa::IntoParams;
use uuid::Uuid;

use super::body::{JsonBody, Params, PictureBody, Segments, object};
use super::maps::map_name;
use super::pixels::PixelParams;
use super::state::AppState;
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{ErrorKind, ImageAnswer, ImageMeta, ImagePage, ImagePatch, ImageState};
use whereabouts_core::{ImageId, MediaType, PoseInput, Recording, moment};
use whereabouts_service::{Deadline, NewImage, ServiceError};
use whereabouts_vision::{AdmissionRequest, WorkClass};

/// What is known about a raw image, in the query string; a form has it in its part `meta`.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct MetaParams {
    /// The id; by default, the beginning of the digest of the bytes.
    id: Option<String>,
    /// When it was taken: RFC 3339 with an offset, or seconds since 1970.
    #[param(value_type = Option<String>)]
    #[serde(default, deserialize_with = "moment::optional")]
    captured_at: Option<Timestamp>,
    /// Tags, separated by commas.
    tags: Option<String>,
    /// The recording that the image belongs to: a UUID of the sender's choice. Tracks follow the images of a recording
    /// in the order of their numbers.
    recording: Option<Uuid>,
    /// With `recording`: the number of the image in it.
    number: Option<u32>,
    /// Latitude in degrees, in a `wgs84` map.
    lat: Option<f64>,
    /// Longitude in degrees.
    lon: Option<f64>,
    /// Height in metres.
    alt: Option<f64>,
    /// Degrees clockwise from north.
    heading: Option<f64>,
    /// Metres, in a `metric` map.
    x: Option<f64>,
    /// Metres.
    y: Option<f64>,
    /// Metres.
    z: Option<f64>,
    /// Unit quaternion.
    qx: Option<f64>,
    /// Unit quaternion.
    qy: Option<f64>,
    /// Unit quaternion.
    qz: Option<f64>,
    /// Unit quaternion.
    qw: Option<f64>,
    /// If the body is pixels without a file format, their layout: `mono8`, `mono16` (little-endian), `rgb8`, `bgr8`,
    /// `rgba8` or `bgra8`. The picture is stored as PNG.
    encoding: Option<String>,
    /// With `encoding`: pixels in a row.
    width: Option<u32>,
    /// With `encoding`: number of rows.
    height: Option<u32>,
    /// With `encoding`: bytes from one row to the next; by default rows follow each other without padding.
    step: Option<u64>,
}

impl MetaParams {
    fn pixels(&self) -> PixelParams<'_> {
        let Self { encoding, width, height, step, .. } = self;
        PixelParams { encoding: encoding.as_deref(), width: *width, height: *height, step: *step }
    }

    fn is_empty(&self) -> bool {
        self.id.is_none()
            && self.captured_at.is_none()
            && self.tags.is_none()
            && self.recording.is_none()
            && self.number.is_none()
            && self.pose().is_none()
    }

    fn pose(&self) -> Option<PoseInput> {
        let Self { lat, lon, alt, heading, x, y, z, qx, qy, qz, qw, .. } = *self;
        let pose = PoseInput { lat, lon, alt, heading, x, y, z, qx, qy, qz, qw };
        (!pose.is_empty()).then_some(pose)
    }

    fn into_meta(self) -> Result<ImageMeta, Problem> {
        let pose = self.pose();
        let tags = self.tags.map(|tags| tags.split(',').map(|tag| tag.trim().to_owned()).collect());
        let recording = match (self.recording, self.number) {
            (Some(id), Some(number)) => Some(Recording { id, number }),
            (None, None) => None,
            _ => {
                let detail = "recording and number belong together: send both, the UUID of a recording and the \
                              number of the image in it, or neither";
                return Err(Problem::new(ErrorKind::Malformed, detail));
            }
        };
        Ok(ImageMeta {
            id: self.id,
            pose,
            captured_at: self.captured_at,
            tags: tags.unwrap_or_default(),
            recording,
        })
    }
}

/// Add an image
///
/// Send either a raw picture, with what is known about it in the query string, or a form with the parts
/// `image` (the picture) and `meta` (JSON). In a `wgs84` map, a new image without a pose gets that of its EXIF
/// data; what of them cannot be trusted is in `warnings`. Sending the same id with the same bytes again is
/// answered 200; a pose, time or tags that differ from what is stored replace it, and what is omitted stays.
#[utoipa::path(post, path = "/maps/{map}/images", tag = "images",
    params(("map" = String, Path), MetaParams,
        ("X-Deadline-Ms" = Option<u32>, Header, minimum = 1, maximum = 3_600_000,
        description = "Milliseconds from arrival that the client waits for the answer. After 504 the \
                       image may or may not be stored; send it again.")),
    request_body(content(
        (Vec<u8> = "image/jpeg"), (Vec<u8> = "image/png"), (Vec<u8> = "image/*"),
        (ImageForm = "multipart/form-data"),
    )),
    responses(
        (status = 200, body = ImageAnswer, description = "Already stored; `changed` names what was updated"),
        (status = 201, body = ImageAnswer, description = "Stored"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The id exists with other bytes", content_type = "application/problem+json"),
        (status = 408, body = Problem, description = "The body arrived too slowly", content_type = "application/problem+json"),
        (status = 413, body = Problem, description = "Too large", content_type = "application/problem+json"),
        (status = 415, body = Problem, description = "Not a supported image type", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "Cannot be decoded, or a pose out of range", content_type = "application/problem+json"),
        (status = 429, body = Problem, description = "Overloaded; Retry-After says when to try again", content_type = "application/problem+json"),
        (status = 504, body = Problem, description = "X-Deadline-Ms has passed", content_type = "application/problem+json"),
        (status = 507, body = Problem, description = "The disk is full", content_type = "application/problem+json"),
    ))]
pub(super) async fn add_image(
    State(state): State<AppState>,
    Ready(service): Ready,
    Segments(map): Segments<String>,
    Params(params): Params<MetaParams>,
    Deadline(deadline): Deadline,
    request: Request,
) -> Result<(StatusCode, Json<ImageAnswer>), Problem> {
    let demand = AdmissionRequest { class: WorkClass::Index, deadline };
    let layout = params.pixels().layout()?;
    let body = PictureBody::read(request, &state, &service, demand, layout).await?;
    let meta = match body.meta {
        Some(_) if !params.is_empty() => {
            let detail = "describe the image either in the part \"meta\" or in the query string, \
                          not in both";
            return Err(Problem::new(ErrorKind::Malformed, detail));
        }
        Some(meta) => meta_from_part(&meta)?,
        None => params.into_meta()?,
    };
    let new = NewImage { bytes: body.picture, meta, demand };
    let (answer, new) = service.images.add(&map_name(&map)?, new).await?;
    Ok((if new { StatusCode::CREATED } else { StatusCode::OK }, Json(answer)))
}

/// The form of an upload.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "describes the form; the body is read part by part")]
struct ImageForm {
    /// The picture.
    #[schema(value_type = String, format = Binary)]
    image: Vec<u8>,
    /// What is known about it.
    meta: Option<ImageMeta>,
}

fn meta_from_part(part: &Bytes) -> Result<ImageMeta, Problem> {
    object(part).map_err(|error| {
        let detail = format!("the part \"meta\" is not the JSON expected: {error}");
        Problem::new(ErrorKind::Malformed, detail)
    })
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct PageParams {
    /// `next_cursor` of the previous page.
    pub cursor: Option<String>,
    /// Images in a page, 1 to 1000; 100 by default.
    pub limit: Option<usize>,
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ImageListParams {
    /// Only images in which this text of at most 100 characters was read, the best match first. Case, accents, width,
    /// spaces, some typing errors and what readers confuse (0 and O, 1 and l, rn and m) make no difference. `matches`
    /// says what matches and where.
    #[param(max_length = 100)]
    text: Option<String>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Images in a page, 1 to 1000; 100 by default.
    limit: Option<usize>,
}

/// List the images of a map, by id, or search for text in them
#[utoipa::path(get, path = "/maps/{map}/images", tag = "images",
    params(("map" = String, Path), ImageListParams), responses(
    (status = 200, body = ImagePage),
    (status = 400, body = Problem, description = "cursor is not that of such a list", content_type = "application/problem+json"),
    (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "The text in the images was not read: no reader is installed, or not yet", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "limit is out of range, or text has no letters or is too long", content_type = "application/problem+json"),
))]
pub(super) async fn list_images(
    Ready(service): Ready,
    Segments(map): Segments<String>,
    Params(page): Params<ImageListParams>,
) -> Result<Json<ImagePage>, Problem> {
    if let Some(text) = &page.text {
        let (map, cursor) = (map_name(&map)?, page.cursor.as_deref());
        return Ok(Json(service.images.find(&map, text, cursor, page.limit).await?));
    }
    let cursor = page.cursor.as_deref().map(image_id).transpose()?;
    Ok(Json(service.images.list(&map_name(&map)?, cursor.as_ref(), page.limit).await?))
}

/// One image, with the text that was read in it
#[utoipa::path(get, path = "/maps/{map}/images/{id}", tag = "images",
    params(("map" = String, Path), ("id" = String, Path)), responses(
    (status = 200, body = ImageState),
    (status = 404, body = Problem, description = "No such image", content_type = "application/problem+json"),
))]
pub(super) async fn get_image(
    Ready(service): Ready,
    Segments((map, id)): Segments<(String, String)>,
) -> Result<Json<ImageState>, Problem> {
    Ok(Json(service.images.state(&map_name(&map)?, &image_id(&id)?).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ContentParams {
    /// Longest edge in pixels, 16 to 4096; by default, the picture is returned as it was sent.
    pub max_edge: Option<u32>,
}

/// The picture of an image
#[utoipa::path(get, path = "/maps/{map}/images/{id}/content", tag = "images",
    params(("map" = String, Path), ("id" = String, Path), ContentParams), responses(
    (status = 200, content((Vec<u8> = "image/jpeg"), (Vec<u8> = "image/png"), (Vec<u8> = "image/*"))),
    (status = 404, body = Problem, description = "No such image", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "max_edge is out of range", content_type = "application/problem+json"),
    (status = 429, body = Problem, description = "Overloaded, and max_edge asks for a smaller picture", content_type = "application/problem+json"),
))]
pub(super) async fn image_content(
    Ready(service): Ready,
    Segments((map, id)): Segments<(String, String)>,
    Params(content): Params<ContentParams>,
) -> Result<impl IntoResponse, Problem> {
    let (media_type, bytes) =
        service.images.content(&map_name(&map)?, &image_id(&id)?, content.max_edge).await?;
    Ok(picture(media_type, bytes))
}

/// A picture. It may be cached: the picture of an id never changes.
pub(super) fn picture(media_type: MediaType, bytes: Bytes) -> impl IntoResponse {
    let headers = [(CONTENT_TYPE, media_type.as_str()), (CACHE_CONTROL, "private, max-age=3600")];
    (headers, bytes)
}

/// Change the pose, time or tags of an image
///
/// The body is a JSON merge patch (RFC 7396): an omitted field keeps its value, and null removes it. The picture
/// and its descriptor stay; a calibration of the map follows later.
#[utoipa::path(patch, path = "/maps/{map}/images/{id}", tag = "images",
    params(("map" = String, Path), ("id" = String, Path)),
    request_body(content(
        (ImagePatch = "application/merge-patch+json"), (ImagePatch = "application/json"),
    )),
    responses(
        (status = 200, body = ImageAnswer, description = "`changed` names what was changed"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such image", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "Other requests are changing the image; try again", content_type = "application/problem+json"),
        (status = 413, body = Problem, description = "Too large", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "A pose that does not fit the map or is out of range, or invalid tags", content_type = "application/problem+json"),
    ))]
pub(super) async fn update_image(
    Ready(service): Ready,
    Segments((map, id)): Segments<(String, String)>,
    JsonBody(patch): JsonBody<ImagePatch>,
) -> Result<Json<ImageAnswer>, Problem> {
    Ok(Json(service.images.update(&map_name(&map)?, &image_id(&id)?, &patch).await?))
}

/// Remove an image
#[utoipa::path(delete, path = "/maps/{map}/images/{id}", tag = "images",
    params(("map" = String, Path), ("id" = String, Path)), responses(
    (status = 204, description = "Removed; no later answer contains it"),
    (status = 404, body = Problem, description = "No such image", content_type = "application/problem+json"),
))]
pub(super) async fn delete_image(
    Ready(service): Ready,
    Segments((map, id)): Segments<(String, String)>,
) -> Result<StatusCode, Problem> {
    service.images.delete(&map_name(&map)?, &image_id(&id)?).await?;
    Ok(StatusCode::NO_CONTENT)
}

pub(super) fn image_id(text: &str) -> Result<ImageId, Problem> {
    Ok(text.parse().map_err(ServiceError::from)?)
}
