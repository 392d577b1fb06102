//! `/maps/{map}/tracks`.

use axum::{Extension, Json};

use super::body::Segments;
use super::maps::map_name;
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{TrackList, TrackWay};
use whereabouts_service::Principal;

/// The tracks in a map
///
/// Those of all API keys, with the latest frames first.
#[utoipa::path(get, path = "/maps/{map}/tracks", tag = "localize", params(("map" = String, Path)), responses(
    (status = 200, body = TrackList),
    (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
))]
pub(super) async fn list_tracks(
    Ready(service): Ready,
    Segments(map): Segments<String>,
) -> Result<Json<TrackList>, Problem> {
    let map = service.maps.find(&map_name(&map)?).await?;
    Ok(Json(service.localizer.tracks.list(&map).await?))
}

/// The way of a robot
///
/// Its last places, each estimated from the frames before and after it. A robot sees its own tracks; an operator those of
/// all keys, by default the one with the latest frame if several keys use the id.
#[utoipa::path(get, path = "/maps/{map}/tracks/{track}", tag = "localize",
    params(("map" = String, Path), ("track" = String, Path)),
    responses(
        (status = 200, body = TrackWay),
        (status = 404, body = Problem, description = "No such map or track", content_type = "application/problem+json"),
    ))]
pub(super) async fn get_track(
    Ready(service): Ready,
    Extension(caller): Extension<Principal>,
    Segments((map, track)): Segments<(String, String)>,
) -> Result<Json<TrackWay>, Problem> {
    let map = service.maps.find(&map_name(&map)?).await?;
    Ok(Json(service.localizer.tracks.way(&map, &caller, &track).await?))
}
