//! `/localize`.

use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;

use super::body::{Params, PictureBody};
use super::maps::map_name;
use super::problem::Problem;
use super::state::Ready;
use crate::domain::Priority;
use crate::service::{Answer, LocalizeRequest, RefineMode};

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct LocalizeParams {
    /// In which map.
    map: String,
    /// How many candidates, 1 to 100.
    k: Option<usize>,
    /// `async` (default): a job refines the candidates. `wait`: the answer waits for it. `off`:
    /// no job.
    #[serde(default)]
    refine: RefineMode,
    /// How soon the job is taken: before all others (`high`), in its turn (`normal`, default), or
    /// when nothing else waits (`low`).
    #[serde(default)]
    priority: Priority,
}

/// The form of a frame.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "describes the form; the body is read part by part")]
struct FrameForm {
    /// The frame.
    #[schema(value_type = String, format = Binary)]
    image: Vec<u8>,
}

/// Localize a frame
///
/// Answers with the most similar images of the map; a job then compares the frame with each of
/// them and orders them anew.
#[utoipa::path(post, path = "/localize", tag = "localize", params(LocalizeParams),
    request_body(content(
        (Vec<u8> = "image/jpeg"), (Vec<u8> = "image/png"), (Vec<u8> = "image/webp"),
        (FrameForm = "multipart/form-data"),
    )),
    responses(
        (status = 200, body = Answer),
        (status = 400, body = Problem, description = "Malformed, or an empty body", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The map's model is not installed, or is another by now", content_type = "application/problem+json"),
        (status = 413, body = Problem, description = "Too large", content_type = "application/problem+json"),
        (status = 415, body = Problem, description = "Not a picture type", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "Cannot be decoded, or k out of range", content_type = "application/problem+json"),
        (status = 429, body = Problem, description = "Overloaded", content_type = "application/problem+json"),
        (status = 507, body = Problem, description = "The disk is full", content_type = "application/problem+json"),
    ))]
pub(super) async fn localize(
    Ready(service): Ready,
    Params(params): Params<LocalizeParams>,
    body: PictureBody,
) -> Result<Json<Answer>, Problem> {
    let request = LocalizeRequest {
        map: map_name(&params.map)?,
        k: params.k,
        refine: params.refine,
        priority: params.priority,
        frame: body.picture,
    };
    Ok(Json(service.localize(request).await?))
}
