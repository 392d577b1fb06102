//! `/jobs`.

use std::time::Duration;

use axum::Json;
use axum::response::IntoResponse;
use serde::Deserialize;
use utoipa::IntoParams;
use uuid::Uuid;

use super::body::{Params, Segments};
use super::images::{ContentParams, image_id, picture};
use super::maps::map_name;
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{ErrorKind, JobPage, PairRegions};
use whereabouts_core::{Job, JobState};
use whereabouts_service::{self};
use whereabouts_store::JobFilter;

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ListParams {
    /// Only jobs of this map.
    map: Option<String>,
    /// Only jobs in this state.
    state: Option<JobState>,
    /// Only jobs that contain this text of at most 200 characters, ignoring case: in their id, query id, map,
    /// state, refiner, error, reasoning or descriptions, or in the ids of their candidates. A request searches
    /// a few thousand jobs at most: continue with `next_cursor` until it is null.
    #[param(max_length = 200)]
    q: Option<String>,
    /// Jobs in a page, 1 to 1000; 100 by default.
    limit: Option<usize>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
    /// Omit `descriptions`, `ranking` and `reasoning`, the largest fields of a job.
    #[serde(default)]
    #[param(required = false)]
    brief: bool,
}

/// List jobs, newest first
#[utoipa::path(get, path = "/jobs", tag = "jobs", params(ListParams), responses(
    (status = 200, body = JobPage),
    (status = 400, body = Problem, description = "Malformed, or q is too long", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "limit is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn list_jobs(
    Ready(service): Ready,
    Params(params): Params<ListParams>,
) -> Result<Json<JobPage>, Problem> {
    let filter = JobFilter {
        map: params.map.as_deref().map(map_name).transpose()?,
        state: params.state,
        text: params
            .q
            .as_deref()
            .map(whereabouts_service::parse_search_text)
            .transpose()?
            .flatten(),
    };
    let cursor = params.cursor.as_deref().map(job_id).transpose()?;
    let mut page = service.jobs.list(filter, cursor, params.limit).await?;
    if params.brief {
        page.jobs = page.jobs.into_iter().map(Job::summary).collect();
    }
    Ok(Json(page))
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct WaitParams {
    /// Wait until the job has ended, for at most this many seconds (long polling).
    wait: Option<f64>,
}

/// One job
#[utoipa::path(get, path = "/jobs/{id}", tag = "jobs",
    params(("id" = Uuid, Path), WaitParams), responses(
    (status = 200, body = Job),
    (status = 404, body = Problem, description = "No such job", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "wait is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn get_job(
    Ready(service): Ready,
    Segments(id): Segments<String>,
    Params(params): Params<WaitParams>,
) -> Result<Json<Job>, Problem> {
    let wait = params.wait.map(seconds).transpose()?;
    Ok(Json(service.jobs.get(job_id(&id)?, wait).await?))
}

/// The frame of a job
#[utoipa::path(get, path = "/jobs/{id}/frame", tag = "jobs",
    params(("id" = Uuid, Path), ContentParams), responses(
    (status = 200, content((Vec<u8> = "image/jpeg"), (Vec<u8> = "image/png"), (Vec<u8> = "image/*"))),
    (status = 404, body = Problem, description = "No such job, or its frame is no longer there", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "max_edge is out of range", content_type = "application/problem+json"),
    (status = 429, body = Problem, description = "Overloaded, and max_edge asks for a smaller picture", content_type = "application/problem+json"),
))]
pub(super) async fn frame(
    Ready(service): Ready,
    Segments(id): Segments<String>,
    Params(params): Params<ContentParams>,
) -> Result<impl IntoResponse, Problem> {
    let (media_type, bytes) = service.jobs.frame(job_id(&id)?, params.max_edge).await?;
    Ok(picture(media_type, bytes))
}

/// What a job's frame and a candidate have in common
///
/// The regions that match, the most distinctive first. Only the refiner `local` compares regions; they are
/// computed for this request, from the pictures as they are now.
#[utoipa::path(get, path = "/jobs/{id}/matches/{image}", tag = "jobs",
    params(("id" = Uuid, Path), ("image" = String, Path)), responses(
    (status = 200, body = PairRegions),
    (status = 404, body = Problem, description = "No such job, or no such matches", content_type = "application/problem+json"),
    (status = 503, body = Problem, description = "Starting, or the model is temporarily unavailable", content_type = "application/problem+json"),
))]
pub(super) async fn matches(
    Ready(service): Ready,
    Segments((id, image)): Segments<(String, String)>,
) -> Result<Json<PairRegions>, Problem> {
    Ok(Json(service.jobs.matches(job_id(&id)?, &image_id(&image)?).await?))
}

/// Cancel a job
///
/// A job that has ended is left unchanged.
#[utoipa::path(post, path = "/jobs/{id}/cancel", tag = "jobs", params(("id" = Uuid, Path)), responses(
    (status = 200, body = Job),
    (status = 404, body = Problem, description = "No such job", content_type = "application/problem+json"),
))]
pub(super) async fn cancel_job(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<Json<Job>, Problem> {
    Ok(Json(service.jobs.cancel(job_id(&id)?).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct RetryParams {
    /// Buy the job's descriptions again, and retry a job that has succeeded, too.
    #[serde(default)]
    #[param(required = false)]
    fresh: bool,
}

/// Queue a failed, degraded or cancelled job again
///
/// Descriptions that are in the cache are not bought again, unless `fresh` is set.
#[utoipa::path(post, path = "/jobs/{id}/retry", tag = "jobs",
    params(("id" = Uuid, Path), RetryParams), responses(
    (status = 200, body = Job),
    (status = 404, body = Problem, description = "No such job", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "The job has not ended, or has succeeded", content_type = "application/problem+json"),
))]
pub(super) async fn retry_job(
    Ready(service): Ready,
    Segments(id): Segments<String>,
    Params(params): Params<RetryParams>,
) -> Result<Json<Job>, Problem> {
    Ok(Json(service.jobs.retry(job_id(&id)?, params.fresh).await?))
}

pub(super) fn job_id(text: &str) -> Result<Uuid, Problem> {
    Ok(whereabouts_service::uuid("job", text)?)
}

fn seconds(seconds: f64) -> Result<Duration, Problem> {
    Duration::try_from_secs_f64(seconds).map_err(|_| {
        Problem::new(ErrorKind::Unprocessable, format!("wait is {seconds}; it must be 0 or more"))
    })
}
