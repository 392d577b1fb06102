//! `/maps/{map}/export` and `/maps/{map}/import`, for `whereabouts backup` and `restore`.

use axum::Json;
use axum::extract::{Request, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderName, StatusCode};
use bytes::Bytes;
use utoipa::ToSchema;

use super::body::{JsonBody, Params, PictureBody, Segments};
use super::images::{PageParams, image_id};
use super::maps::map_name;
use super::state::AppState;
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{ErrorKind, ExportPage, ImportedImage, ImportedMap, MapState};
use whereabouts_core::Image;
use whereabouts_store::Added;
use whereabouts_vision::{AdmissionRequest, WorkClass};

/// The images of a map with their descriptors, by id
///
/// Get the bytes of each at `/maps/{map}/images/{id}/content`. `whereabouts backup` writes all of them into one
/// file.
#[utoipa::path(get, path = "/maps/{map}/export", tag = "maps",
    params(("map" = String, Path), PageParams), responses(
    (status = 200, body = ExportPage),
    (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "limit is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn export(
    Ready(service): Ready,
    Segments(map): Segments<String>,
    Params(page): Params<PageParams>,
) -> Result<Json<ExportPage>, Problem> {
    let cursor = page.cursor.as_deref().map(image_id).transpose()?;
    Ok(Json(service.transfer.export(&map_name(&map)?, cursor.as_ref(), page.limit).await?))
}

/// The vocabulary that a map has of its own
///
/// Its SHA-256 is `vocabulary.digest` of the map. `whereabouts backup` saves it.
#[utoipa::path(get, path = "/maps/{map}/vocabulary", tag = "maps", params(("map" = String, Path)), responses(
    (status = 200, body = String, description = "16-bit floats", content_type = "application/octet-stream"),
    (status = 404, body = Problem, description = "No such map, or it has the vocabulary of its model", content_type = "application/problem+json"),
))]
pub(super) async fn vocabulary(
    Ready(service): Ready,
    Segments(map): Segments<String>,
) -> Result<([(HeaderName, &'static str); 1], Bytes), Problem> {
    let bytes = service.transfer.vocabulary(&map_name(&map)?).await?;
    Ok(([(CONTENT_TYPE, "application/octet-stream")], bytes))
}

/// Create a map like one that was exported
///
/// An existing map with the same kind of descriptors is left unchanged. The model need not be installed yet.
#[utoipa::path(put, path = "/maps/{map}/import", tag = "maps", params(("map" = String, Path)),
    request_body(content = ImportedMap, description = "`map` of an export"),
    responses(
        (status = 200, body = MapState, description = "The map exists"),
        (status = 201, body = MapState, description = "Created"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The map has images with other descriptors", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "A value is out of range", content_type = "application/problem+json"),
    ))]
pub(super) async fn import_map(
    Ready(service): Ready,
    Segments(map): Segments<String>,
    JsonBody(from): JsonBody<ImportedMap>,
) -> Result<(StatusCode, Json<MapState>), Problem> {
    let (state, new) = service.transfer.import_map(&map_name(&map)?, from).await?;
    Ok((if new { StatusCode::CREATED } else { StatusCode::OK }, Json(state)))
}

/// The form of an image that was exported.
#[derive(ToSchema)]
#[expect(dead_code, reason = "describes the form; the body is read part by part")]
pub(super) struct ImportForm {
    /// The picture.
    #[schema(value_type = String, format = Binary)]
    image: Vec<u8>,
    /// Its entry in the export.
    meta: ImportedImage,
}

/// Add an image with its exported descriptor
///
/// Sending the same id with the same bytes again is answered 200, so it is safe to repeat an import.
#[utoipa::path(post, path = "/maps/{map}/import", tag = "maps", params(("map" = String, Path)),
    request_body(content = ImportForm, content_type = "multipart/form-data"),
    responses(
        (status = 200, body = Image, description = "Already stored"),
        (status = 201, body = Image, description = "Stored"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The id exists with other bytes, or the map has other descriptors", content_type = "application/problem+json"),
        (status = 413, body = Problem, description = "Too large", content_type = "application/problem+json"),
        (status = 415, body = Problem, description = "Not a form", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "The bytes do not match the digest, or a value is out of range", content_type = "application/problem+json"),
        (status = 429, body = Problem, description = "Overloaded; Retry-After says when to try again", content_type = "application/problem+json"),
        (status = 507, body = Problem, description = "The disk is full", content_type = "application/problem+json"),
    ))]
pub(super) async fn import_image(
    State(state): State<AppState>,
    Ready(service): Ready,
    Segments(map): Segments<String>,
    request: Request,
) -> Result<(StatusCode, Json<Image>), Problem> {
    let demand = AdmissionRequest { class: WorkClass::Index, deadline: None };
    let body = PictureBody::read(request, &state, &service, demand, None).await?;
    let meta = body.meta.unwrap_or_default();
    let from: ImportedImage = serde_json::from_slice(&meta).map_err(|error| {
        let detail = format!("the part \"meta\" is not the JSON expected: {error}");
        Problem::new(ErrorKind::Malformed, detail)
    })?;
    Ok(match service.transfer.import_image(&map_name(&map)?, from, body.picture, demand).await? {
        Added::Created(image) => (StatusCode::CREATED, Json(image)),
        Added::Present(image) => (StatusCode::OK, Json(image)),
    })
}
