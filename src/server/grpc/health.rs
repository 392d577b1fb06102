//! The standard health and reflection services.

use futures_util::{StreamExt, stream};
use tonic::{Request, Response, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_server::Health;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};
use tonic_reflection::server::{Builder, Error};

use super::streams::{ResponseStream, until_over};
use super::{Api, CONTRACT, status};
use whereabouts_service::ReadinessPhase;

/// Services whose health can be queried; the empty name is the server as a whole.
const SERVICES: [&str; 4] = [
    "",
    "whereabouts.v1.LocalizationService",
    "whereabouts.v1.MapService",
    "whereabouts.v1.JobService",
];

fn serving_status(phase: ReadinessPhase) -> HealthCheckResponse {
    let status = match phase {
        ReadinessPhase::Open => ServingStatus::Serving,
        ReadinessPhase::Starting | ReadinessPhase::Draining => ServingStatus::NotServing,
    };
    HealthCheckResponse { status: status.into() }
}

#[tonic::async_trait]
impl Health for Api {
    type WatchStream = ResponseStream<HealthCheckResponse>;

    async fn check(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<HealthCheckResponse>, Status> {
        let name = &request.get_ref().service;
        if !SERVICES.contains(&name.as_str()) {
            let shown: String = name.chars().take(80).collect();
            let known = SERVICES[1..].join(", ");
            return Err(Status::not_found(format!(
                "there is no service {shown:?}; there are {known}"
            )));
        }
        Ok(Response::new(serving_status(*self.readiness.phases().borrow())))
    }

    async fn watch(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        if !SERVICES.contains(&request.get_ref().service.as_str()) {
            // The protocol requires an open stream: the service might appear later.
            let unknown = HealthCheckResponse { status: ServingStatus::ServiceUnknown.into() };
            let unknown = stream::iter([Ok(unknown)]).chain(stream::pending());
            return Ok(Response::new(until_over(unknown, &self.readiness, context)));
        }
        let mut phases = self.readiness.phases();
        phases.mark_changed();
        let changes = stream::unfold(phases, |mut phases| async {
            phases.changed().await.ok()?;
            let now = serving_status(*phases.borrow_and_update());
            Some((Ok(now), phases))
        });
        Ok(Response::new(until_over(changes, &self.readiness, context)))
    }
}

fn reflection() -> Builder<'static> {
    Builder::configure()
        .register_encoded_file_descriptor_set(CONTRACT)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
}

pub(super) fn reflection_v1() -> Result<
    tonic_reflection::server::v1::ServerReflectionServer<
        impl tonic_reflection::server::v1::ServerReflection,
    >,
    Error,
> {
    reflection().build_v1()
}

pub(super) fn reflection_v1alpha() -> Result<
    tonic_reflection::server::v1alpha::ServerReflectionServer<
        impl tonic_reflection::server::v1alpha::ServerReflection,
    >,
    Error,
> {
    reflection().build_v1alpha()
}
