//! gRPC: extracts a message, calls the service, converts the answer. The contract is in `proto/`.
//!
//! The calls are routes like those of HTTP, behind the same gate: bounds, keys, roles, counts. Errors of the
//! gate and of the service become a status in [`status`].

mod convert;
mod health;
mod jobs;
mod localization;
mod maps;
mod streams;

use std::sync::Arc;

use tonic::Extensions;
use tonic_health::pb::health_server::HealthServer;

use self::proto::job_service_server::JobServiceServer;
use self::proto::localization_service_server::LocalizationServiceServer;
use self::proto::map_service_server::MapServiceServer;
use crate::Metrics;
use crate::gate::{BodyBudget, Gate, RoutePolicy, Routes, Waits, grpc_status as status};
use whereabouts_api::ErrorKind;
use whereabouts_core::MapName;
use whereabouts_service::{Deadline, Principal, Readiness, Service, ServiceError};

use whereabouts_api::{DESCRIPTOR_SET as CONTRACT, proto};

const REFLECTION: &str = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";
const REFLECTION_ALPHA: &str = "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo";

/// Answers the calls of the contract, and those of the standard health service.
#[derive(Clone)]
struct Api {
    readiness: Readiness,
    metrics: Arc<Metrics>,
}

/// All calls: one line says what the gate needs to know about each.
pub(crate) fn routes<S: Clone + Send + Sync + 'static>(gate: &Gate) -> Routes<S> {
    let api = Api { readiness: gate.readiness.clone(), metrics: Arc::clone(&gate.metrics) };
    // The gate has refused larger messages before.
    let largest = gate.settings.server.body_limit_bytes;
    let localization =
        LocalizationServiceServer::new(api.clone()).max_decoding_message_size(largest);
    let maps = MapServiceServer::new(api.clone()).max_decoding_message_size(largest);
    let jobs = JobServiceServer::new(api.clone()).max_decoding_message_size(largest);
    let health = HealthServer::new(api);
    let (public, robot) = (RoutePolicy::public().grpc(), RoutePolicy::robot().grpc());
    let (operator, admin) = (RoutePolicy::operator().grpc(), RoutePolicy::admin().grpc());
    let routes = Routes::new()
        .call(
            "/whereabouts.v1.LocalizationService/Localize",
            robot.pictures().waits(Waits::Always).localizes(),
            localization.clone(),
        )
        .call(
            "/whereabouts.v1.LocalizationService/LocalizeStream",
            robot.pictures().streams(),
            localization,
        )
        .call("/whereabouts.v1.MapService/ListMaps", robot, maps.clone())
        .call("/whereabouts.v1.MapService/GetMap", robot, maps.clone())
        .call("/whereabouts.v1.MapService/PutMap", admin.changes(), maps.clone())
        .call("/whereabouts.v1.MapService/DeleteMap", admin.changes(), maps.clone())
        .call(
            "/whereabouts.v1.MapService/AddImages",
            operator.pictures().bulk().changes(),
            maps.clone(),
        )
        .call("/whereabouts.v1.MapService/UpdateImage", operator.changes(), maps.clone())
        .call("/whereabouts.v1.MapService/FindImages", operator, maps)
        .call("/whereabouts.v1.JobService/GetJob", robot.waits(Waits::Always), jobs.clone())
        .call("/whereabouts.v1.JobService/WatchJob", robot.streams(), jobs.clone())
        .call("/whereabouts.v1.JobService/ListJobs", operator, jobs.clone())
        .call("/whereabouts.v1.JobService/CancelJob", operator.changes(), jobs.clone())
        .call("/whereabouts.v1.JobService/RetryJob", operator.changes(), jobs)
        .call("/grpc.health.v1.Health/Check", public.probe(), health.clone())
        // Not public: it keeps a stream open, and their number is bounded.
        .call("/grpc.health.v1.Health/Watch", robot.streams(), health);
    // Clients choose the version of reflection.
    match (health::reflection_v1(), health::reflection_v1alpha()) {
        (Ok(v1), Ok(v1alpha)) => routes.call(REFLECTION, robot.streams(), v1).call(
            REFLECTION_ALPHA,
            robot.streams(),
            v1alpha,
        ),
        (Err(error), _) | (_, Err(error)) => {
            tracing::error!(%error, "there is no reflection");
            routes
        }
    }
}

/// The caller of a call, its deadline, and what answers it.
#[derive(Clone)]
struct CallContext {
    service: Arc<Service>,
    metrics: Arc<Metrics>,
    caller: Principal,
    deadline: Deadline,
    budget: BodyBudget,
}

impl Api {
    fn context(&self, extensions: &Extensions) -> Result<CallContext, ServiceError> {
        let deadline = extensions.get::<Deadline>().copied().unwrap_or_default();
        // The gate inserts the caller once it is authorized.
        let caller = extensions.get::<Principal>().cloned().ok_or_else(|| {
            ServiceError::new(ErrorKind::Internal, "a call was not checked; see the server's log")
        })?;
        let budget = extensions.get::<BodyBudget>().cloned().unwrap_or_default();
        let metrics = Arc::clone(&self.metrics);
        Ok(CallContext { service: self.readiness.service()?, metrics, caller, deadline, budget })
    }
}

impl CallContext {
    /// Parses the name of a map, and checks that the caller may use it. Every map of a request passes here.
    fn map(&self, name: &str) -> Result<MapName, ServiceError> {
        let map: MapName = name.parse()?;
        self.caller.check_map(&map)?;
        Ok(map)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gate::{GateSettings, MapSource};
    use axum::http::Method;
    use prost::Message;
    use prost_types::FileDescriptorSet;

    #[test]
    fn every_method_of_the_contract_has_a_policy_that_agrees_on_streaming() {
        let gate = Gate::new(GateSettings::small(), Arc::default());
        let policies = routes::<()>(&gate).policies;
        let mut methods = 0;
        for contract in [CONTRACT, tonic_health::pb::FILE_DESCRIPTOR_SET] {
            for file in FileDescriptorSet::decode(contract).unwrap().file {
                for service in &file.service {
                    for method in &service.method {
                        let path =
                            format!("/{}.{}/{}", file.package(), service.name(), method.name());
                        let streams = method.client_streaming() || method.server_streaming();
                        let policy = policies.of(&Method::POST, &path).unwrap();
                        assert_eq!(policy.streams, streams, "{path}");
                        assert!(policy.is_grpc() && policy.map == MapSource::Handler, "{path}");
                        methods += 1;
                    }
                }
            }
        }
        assert_eq!(methods, 16);
        for path in [REFLECTION, REFLECTION_ALPHA] {
            assert!(policies.of(&Method::POST, path).unwrap().streams);
        }
    }
}
