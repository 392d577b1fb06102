//! `/jobs`.

use std::time::Duration;

use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;
use uuid::Uuid;

use super::body::{Params, Segments};
use super::maps::map_name;
use super::problem::Problem;
use super::state::Ready;
use crate::domain::{Job, JobState};
use crate::service::{ErrorKind, JobPage};
use crate::store::JobFilter;

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ListParams {
    /// Only jobs of this map.
    map: Option<String>,
    /// Only jobs in this state.
    state: Option<JobState>,
    /// Jobs in a page, 1 to 1000; 100 by default.
    limit: Option<usize>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
}

/// List jobs, newest first
#[utoipa::path(get, path = "/jobs", tag = "jobs", params(ListParams), responses(
    (status = 200, body = JobPage),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "limit is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn list_jobs(
    Ready(service): Ready,
    Params(params): Params<ListParams>,
) -> Result<Json<JobPage>, Problem> {
    let filter =
        JobFilter { map: params.map.as_deref().map(map_name).transpose()?, state: params.state };
    let cursor = params.cursor.as_deref().map(job_id).transpose()?;
    Ok(Json(service.list_jobs(filter, cursor, params.limit).await?))
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct WaitParams {
    /// Answer when the job has ended, but after so many seconds at the latest.
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
    Ok(Json(service.get_job(job_id(&id)?, wait).await?))
}

/// Cancel a job
///
/// One that has ended stays as it is.
#[utoipa::path(post, path = "/jobs/{id}/cancel", tag = "jobs", params(("id" = Uuid, Path)), responses(
    (status = 200, body = Job),
    (status = 404, body = Problem, description = "No such job", content_type = "application/problem+json"),
))]
pub(super) async fn cancel_job(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<Json<Job>, Problem> {
    Ok(Json(service.cancel_job(job_id(&id)?).await?))
}

/// Queue a failed, degraded or cancelled job again
#[utoipa::path(post, path = "/jobs/{id}/retry", tag = "jobs", params(("id" = Uuid, Path)), responses(
    (status = 200, body = Job),
    (status = 404, body = Problem, description = "No such job", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "It has not ended, or succeeded", content_type = "application/problem+json"),
))]
pub(super) async fn retry_job(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<Json<Job>, Problem> {
    Ok(Json(service.retry_job(job_id(&id)?).await?))
}

pub(super) fn job_id(text: &str) -> Result<Uuid, Problem> {
    text.parse().map_err(|_| {
        let shown: String = text.chars().take(80).collect();
        Problem::new(ErrorKind::Malformed, format!("a job id is a UUID; got {shown:?}"))
    })
}

fn seconds(seconds: f64) -> Result<Duration, Problem> {
    Duration::try_from_secs_f64(seconds).map_err(|_| {
        Problem::new(ErrorKind::Unprocessable, format!("wait is {seconds}; it must be 0 or more"))
    })
}
