//! `JobService`: get, watch, list, cancel, retry.

use std::time::Duration;

use futures_util::StreamExt;
use tonic::{Request, Response, Status};

use super::proto::job_service_server::JobService;
use super::proto::watch_job_response::Event;
use super::proto::{
    CancelJobRequest, CancelJobResponse, GetJobRequest, GetJobResponse, JobStatus, ListJobsRequest,
    ListJobsResponse, PairDescribed, RetryJobRequest, RetryJobResponse, WatchJobRequest,
    WatchJobResponse,
};
use super::streams::{ResponseStream, until_over};
use super::{Api, CallContext, convert, status};
use whereabouts_api::ErrorKind;
use whereabouts_core::Job;
use whereabouts_service::{JobEvent, ServiceError, parse_search_text, uuid};
use whereabouts_store::JobFilter;

/// Default page size. By default, gRPC clients accept messages of four megabytes at most.
const PAGE_SIZE: usize = 20;

#[tonic::async_trait]
impl JobService for Api {
    type WatchJobStream = ResponseStream<WatchJobResponse>;

    async fn get_job(
        &self,
        request: Request<GetJobRequest>,
    ) -> Result<Response<GetJobResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let GetJobRequest { id, wait_s } = request.into_inner();
        let job = context.job(&id, wait_s).await.map_err(status::of)?;
        Ok(Response::new(GetJobResponse { job: Some(job.into()) }))
    }

    async fn watch_job(
        &self,
        request: Request<WatchJobRequest>,
    ) -> Result<Response<Self::WatchJobStream>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let watching = async {
            let id = context.job(&request.into_inner().id, 0.0).await?.id;
            context.service.jobs.follow(id).await
        };
        let events = watching.await.map_err(status::of)?;
        let events = events.map(|event| {
            let event = match event {
                JobEvent::State(now) => Event::Status(JobStatus {
                    state: whereabouts_api::job_state_to(now.state).into(),
                    attempts: now.attempts,
                    error: now.error.unwrap_or_default(),
                }),
                JobEvent::Described(pair) => Event::Described(PairDescribed {
                    described: pair.described as u32,
                    of: pair.of as u32,
                    description: Some(pair.description.into()),
                }),
                JobEvent::Ended(job) => Event::Ended((*job).into()),
            };
            Ok(WatchJobResponse { event: Some(event) })
        });
        Ok(Response::new(until_over(events, &self.readiness, context)))
    }

    async fn list_jobs(
        &self,
        request: Request<ListJobsRequest>,
    ) -> Result<Response<ListJobsResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let page = context.jobs(request.into_inner()).await.map_err(status::of)?;
        Ok(Response::new(page))
    }

    async fn cancel_job(
        &self,
        request: Request<CancelJobRequest>,
    ) -> Result<Response<CancelJobResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let cancelling = async {
            let id = context.job(&request.into_inner().id, 0.0).await?.id;
            context.service.jobs.cancel(id).await
        };
        let job = cancelling.await.map_err(status::of)?;
        Ok(Response::new(CancelJobResponse { job: Some(job.into()) }))
    }

    async fn retry_job(
        &self,
        request: Request<RetryJobRequest>,
    ) -> Result<Response<RetryJobResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let RetryJobRequest { id, fresh } = request.into_inner();
        let retrying = async {
            let id = context.job(&id, 0.0).await?.id;
            context.service.jobs.retry(id, fresh).await
        };
        let job = retrying.await.map_err(status::of)?;
        Ok(Response::new(RetryJobResponse { job: Some(job.into()) }))
    }
}

impl CallContext {
    /// Returns a job of a map that the caller may use; with `wait_s`, once it has ended or the time is up.
    async fn job(&self, id: &str, wait_s: f64) -> Result<Job, ServiceError> {
        let id = uuid("job", id)?;
        let job = self.service.jobs.get(id, None).await?;
        self.caller.check_map(&job.map)?;
        if wait_s == 0.0 {
            return Ok(job);
        }
        let wait = Duration::try_from_secs_f64(wait_s).map_err(|_| {
            ServiceError::unprocessable(format!("wait_s is {wait_s}; it must be 0 or more"))
        })?;
        self.service.jobs.get(id, Some(wait)).await
    }

    async fn jobs(&self, request: ListJobsRequest) -> Result<ListJobsResponse, ServiceError> {
        let ListJobsRequest { map, state, page_size, page_token, text } = request;
        let map = (!map.is_empty()).then(|| self.map(&map)).transpose()?;
        if map.is_none() && !self.caller.may_use_all() {
            return Err(ServiceError::new(
                ErrorKind::Forbidden,
                "this key is restricted to some maps, but the request is about all; name one in `map`, or ask \
                 an admin for another key",
            ));
        }
        let (state, text) = (convert::job_state(state)?, parse_search_text(&text)?);
        let filter = JobFilter { map, state, text };
        let cursor = (!page_token.is_empty()).then(|| uuid("job", &page_token)).transpose()?;
        let limit = match page_size {
            0 => PAGE_SIZE,
            size => size as usize,
        };
        let page = self.service.jobs.list(filter, cursor, Some(limit)).await?;
        Ok(ListJobsResponse {
            jobs: page.jobs.into_iter().map(Into::into).collect(),
            next_page_token: page.next_cursor.map(|id| id.to_string()).unwrap_or_default(),
        })
    }
}
