//! `/jobs/{id}/events` and `/events`: the progress of one job, or of all, as server-sent events.

use std::time::Duration;

use axum::Extension;
use axum::extract::State;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::{Stream, StreamExt, stream};
use serde::Deserialize;
use utoipa::IntoParams;

use super::body::{Params, Segments};
use super::jobs::job_id;
use super::maps::map_name;
use super::state::AppState;
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_service::{AnyJobEvent, Deadline, JobEvent, Principal, ServiceError};

/// Interval of keep-alive comments, so that proxies do not close an idle stream.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// Follow a job
///
/// Server-sent events until the job has ended: `state` with a `JobStatus` when its state or attempt
/// changes, `description` with a `PairDescribed` for each pair, and finally `end` with the `Job`.
/// Earlier events are replayed first, so that a client that lost the connection can simply reconnect.
#[utoipa::path(get, path = "/jobs/{id}/events", tag = "jobs",
    params(("id" = uuid::Uuid, Path)), responses(
    (status = 200, body = String, content_type = "text/event-stream"),
    (status = 404, body = Problem, description = "No such job", content_type = "application/problem+json"),
    (status = 429, body = Problem, description = "Too many streams are open", content_type = "application/problem+json"),
))]
pub(super) async fn follow_job(
    State(state): State<AppState>,
    Ready(service): Ready,
    Extension(caller): Extension<Principal>,
    Segments(id): Segments<String>,
) -> Result<Sse<impl Stream<Item = Result<Event, axum::Error>>>, Problem> {
    let permit = state.gate.stream_permit()?;
    let events = service.follow_job(job_id(&id)?).await?.map(move |event| {
        // Released when the stream ends or the client has gone.
        let _permit = &permit;
        match event {
            JobEvent::State(status) => Event::default().event("state").json_data(status),
            JobEvent::Described(pair) => Event::default().event("description").json_data(pair),
            JobEvent::Ended(job) => Event::default().event("end").json_data(job),
        }
    });
    Ok(streamed(events, service.over(&state.gate.readiness, caller, Deadline::default())))
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct FollowParams {
    /// Only jobs of this map.
    map: Option<String>,
}

/// Follow all jobs
///
/// An endless stream of server-sent events, starting now: `job` with a `JobChange` whenever a job makes
/// progress or ends, and `missed` with a `Missed` when events were dropped because the client read too slowly.
/// List the jobs once the stream is open, and again after `missed`. A comment is sent at once, so that a client
/// that waits for the first bytes knows that the stream is open.
#[utoipa::path(get, path = "/events", tag = "jobs", params(FollowParams), responses(
    (status = 200, body = String, content_type = "text/event-stream"),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 429, body = Problem, description = "Too many streams are open", content_type = "application/problem+json"),
))]
pub(super) async fn follow_jobs(
    State(state): State<AppState>,
    Ready(service): Ready,
    Extension(caller): Extension<Principal>,
    Params(params): Params<FollowParams>,
) -> Result<Sse<impl Stream<Item = Result<Event, axum::Error>>>, Problem> {
    let map = params.map.as_deref().map(map_name).transpose()?;
    let permit = state.gate.stream_permit()?;
    let events = service.follow_jobs(map).map(move |event| {
        let _permit = &permit;
        match event {
            AnyJobEvent::Changed(change) => Event::default().event("job").json_data(change),
            AnyJobEvent::Missed(missed) => Event::default().event("missed").json_data(missed),
        }
    });
    let opened = stream::once(async { Ok(Event::default().comment("open")) });
    Ok(streamed(
        opened.chain(events),
        service.over(&state.gate.readiness, caller, Deadline::default()),
    ))
}

/// Sends events until they end, the server drains, or the caller's key is no longer valid. A drain does not
/// wait for the jobs, which may not finish before the next start.
fn streamed(
    events: impl Stream<Item = Result<Event, axum::Error>> + Send + 'static,
    over: impl Future<Output = ServiceError> + Send + 'static,
) -> Sse<impl Stream<Item = Result<Event, axum::Error>>> {
    let events = events.take_until(Box::pin(over));
    Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE))
}
