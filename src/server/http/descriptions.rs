//! `/descriptions`.

use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;
use whereabouts_api::{DescriptionPage, ErrorKind, KeyedDescription, PurgedDescriptions};
use whereabouts_core::Digest;
use whereabouts_store::DescriptionFilter;

use super::body::{Params, Segments};
use super::images::image_id;
use super::maps::map_name;
use crate::gate::Problem;
use crate::gate::Ready;

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ListParams {
    /// Only descriptions of this map.
    map: Option<String>,
    /// Only descriptions of pairs with this image.
    image: Option<String>,
    /// Only descriptions by this model.
    model: Option<String>,
    /// Only descriptions from the server at this base URL, as `GET /status` shows it.
    model_server: Option<String>,
    /// Only descriptions that contain this text, ignoring case.
    q: Option<String>,
    /// Descriptions in a page, 1 to 1000; 100 by default.
    limit: Option<usize>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct PurgeParams {
    /// Only descriptions of this map.
    map: Option<String>,
    /// Only descriptions of pairs with this image.
    image: Option<String>,
    /// Only descriptions by this model.
    model: Option<String>,
    /// Only descriptions from the server at this base URL, as `GET /status` shows it.
    model_server: Option<String>,
    /// Only descriptions that contain this text, ignoring case.
    q: Option<String>,
    /// All descriptions. Without another parameter, this one must be set.
    #[serde(default)]
    #[param(required = false)]
    all: bool,
}

/// List cached descriptions
///
/// In the order of their keys.
#[utoipa::path(get, path = "/descriptions", tag = "jobs", params(ListParams), responses(
    (status = 200, body = DescriptionPage),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "limit is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn list_descriptions(
    Ready(service): Ready,
    Params(params): Params<ListParams>,
) -> Result<Json<DescriptionPage>, Problem> {
    let ListParams { map, image, model, model_server, q, limit, cursor } = params;
    let filter = filter(map, image, model, model_server, q)?;
    let cursor = cursor.as_deref().map(key_of).transpose()?;
    Ok(Json(service.descriptions.list(&filter, cursor, limit).await?))
}

/// One cached description
#[utoipa::path(get, path = "/descriptions/{key}", tag = "jobs", params(("key" = String, Path)), responses(
    (status = 200, body = KeyedDescription),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 404, body = Problem, description = "No such description", content_type = "application/problem+json"),
))]
pub(super) async fn get_description(
    Ready(service): Ready,
    Segments(key): Segments<String>,
) -> Result<Json<KeyedDescription>, Problem> {
    Ok(Json(service.descriptions.get(key_of(&key)?).await?))
}

/// Remove a cached description
///
/// The pair is described again when a job needs it.
#[utoipa::path(delete, path = "/descriptions/{key}", tag = "jobs", params(("key" = String, Path)), responses(
    (status = 200, body = PurgedDescriptions),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 404, body = Problem, description = "No such description", content_type = "application/problem+json"),
))]
pub(super) async fn remove_description(
    Ready(service): Ready,
    Segments(key): Segments<String>,
) -> Result<Json<PurgedDescriptions>, Problem> {
    Ok(Json(service.descriptions.remove(key_of(&key)?).await?))
}

/// Remove cached descriptions
///
/// Those that match all parameters. The pairs are described again when a job needs them.
#[utoipa::path(delete, path = "/descriptions", tag = "jobs", params(PurgeParams), responses(
    (status = 200, body = PurgedDescriptions),
    (status = 400, body = Problem, description = "Malformed, or no parameter says which", content_type = "application/problem+json"),
))]
pub(super) async fn purge_descriptions(
    Ready(service): Ready,
    Params(params): Params<PurgeParams>,
) -> Result<Json<PurgedDescriptions>, Problem> {
    let PurgeParams { map, image, model, model_server, q, all } = params;
    let filter = filter(map, image, model, model_server, q)?;
    if filter == DescriptionFilter::default() && !all {
        return Err(Problem::new(
            ErrorKind::Malformed,
            "say which descriptions to remove: map, image, model, model_server or q; or all=true",
        ));
    }
    Ok(Json(service.descriptions.purge(&filter).await?))
}

fn filter(
    map: Option<String>,
    image: Option<String>,
    model: Option<String>,
    server: Option<String>,
    text: Option<String>,
) -> Result<DescriptionFilter, Problem> {
    Ok(DescriptionFilter {
        map: map.as_deref().map(map_name).transpose()?,
        image: image.as_deref().map(image_id).transpose()?,
        model,
        server,
        text,
    })
}

fn key_of(text: &str) -> Result<Digest, Problem> {
    text.parse().map_err(|_| {
        let shown: String = text.chars().take(80).collect();
        let told =
            format!("the key of a description is sha256: and 64 hexadecimal digits; got {shown:?}");
        Problem::new(ErrorKind::Malformed, told)
    })
}
