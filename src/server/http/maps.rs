//! `/maps`.

use axum::http::StatusCode;
use axum::{Extension, Json};
use serde::Serialize;
use utoipa::ToSchema;

use super::body::{JsonBody, Segments};
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{MapChange, MapState, ReindexRequest};
use whereabouts_core::MapName;
use whereabouts_service::Principal;

/// All maps.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct MapList {
    /// Sorted by name.
    maps: Vec<MapState>,
}

pub(super) fn map_name(text: &str) -> Result<MapName, Problem> {
    Ok(text.parse().map_err(whereabouts_service::ServiceError::from)?)
}

/// List the maps
///
/// Only those that the caller's key includes.
#[utoipa::path(get, path = "/maps", tag = "maps", responses(
    (status = 200, body = MapList),
    (status = 503, body = Problem, description = "Starting", content_type = "application/problem+json"),
))]
pub(super) async fn list_maps(
    Ready(service): Ready,
    Extension(caller): Extension<Principal>,
) -> Result<Json<MapList>, Problem> {
    let mut maps = service.maps.list().await?;
    maps.retain(|map| caller.may_use(&map.name));
    Ok(Json(MapList { maps }))
}

/// One map
#[utoipa::path(get, path = "/maps/{map}", tag = "maps", params(("map" = String, Path)), responses(
    (status = 200, body = MapState),
    (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
))]
pub(super) async fn get_map(
    Ready(service): Ready,
    Segments(map): Segments<String>,
) -> Result<Json<MapState>, Problem> {
    Ok(Json(service.maps.get(&map_name(&map)?).await?))
}

/// Create or change a map
#[utoipa::path(put, path = "/maps/{map}", tag = "maps", params(("map" = String, Path)),
    request_body(content = MapChange, description = "What to set; omitted fields keep their values"),
    responses(
        (status = 200, body = MapState, description = "Changed"),
        (status = 201, body = MapState, description = "Created"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 403, body = Problem, description = "The refiner is not allowed on this server", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The field is fixed, because the map has images", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "The model is not installed, or does not support this", content_type = "application/problem+json"),
    ))]
pub(super) async fn put_map(
    Ready(service): Ready,
    Segments(map): Segments<String>,
    JsonBody(change): JsonBody<MapChange>,
) -> Result<(StatusCode, Json<MapState>), Problem> {
    let (state, new) = service.maps.put(map_name(&map)?, change).await?;
    Ok((if new { StatusCode::CREATED } else { StatusCode::OK }, Json(state)))
}

/// Recompute all descriptors of a map, with another model
///
/// Answers at once. The old descriptors are used until all new ones are ready; then the map switches to them
/// atomically. The field `reindex` of the map shows the progress. `vocabulary` asks for a vocabulary that is fitted on the
/// images of the map, or for that of the model.
#[utoipa::path(post, path = "/maps/{map}/reindex", tag = "maps", params(("map" = String, Path)),
    request_body(content = ReindexRequest, description = "Which descriptors; omitted fields keep their values"),
    responses(
        (status = 202, body = MapState, description = "Started"),
        (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The map is being reindexed already", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "The model is not installed, or does not support this", content_type = "application/problem+json"),
    ))]
pub(super) async fn reindex(
    Ready(service): Ready,
    Segments(map): Segments<String>,
    JsonBody(request): JsonBody<ReindexRequest>,
) -> Result<(StatusCode, Json<MapState>), Problem> {
    let state = service.reindexer.start(&map_name(&map)?, request).await?;
    Ok((StatusCode::ACCEPTED, Json(state)))
}

/// Remove a map with all its images
#[utoipa::path(delete, path = "/maps/{map}", tag = "maps", params(("map" = String, Path)), responses(
    (status = 204, description = "Removed"),
    (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
))]
pub(super) async fn delete_map(
    Ready(service): Ready,
    Segments(map): Segments<String>,
) -> Result<StatusCode, Problem> {
    service.maps.delete(&map_name(&map)?).await?;
    Ok(StatusCode::NO_CONTENT)
}
