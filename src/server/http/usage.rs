//! `/usage`.

use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;
use whereabouts_api::UsageReport;

use super::body::Params;
use super::maps::map_name;
use crate::gate::Problem;
use crate::gate::Ready;

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct UsageParams {
    /// Only the usage of this map.
    map: Option<String>,
    /// Number of days to report, including today (UTC); 30 by default.
    days: Option<u32>,
}

/// Usage and cost of external models
///
/// By day and map, as billed. Entries of a deleted map are kept.
#[utoipa::path(get, path = "/usage", tag = "jobs", params(UsageParams), responses(
    (status = 200, body = UsageReport),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "days is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn usage(
    Ready(service): Ready,
    Params(params): Params<UsageParams>,
) -> Result<Json<UsageReport>, Problem> {
    let map = params.map.as_deref().map(map_name).transpose()?;
    Ok(Json(service.usage(map, params.days.unwrap_or(30)).await?))
}
