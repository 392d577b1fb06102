//! gRPC: extract, call the service, convert. The contract is in `proto/`.
//!
//! The services are routes beside those of HTTP, and pass what those pass: bounds, keys, roles, counts.
//! What was refused on the way there, or by the service, is a status ([`status`]).

mod calls;
mod convert;
mod health;
mod held;
mod jobs;
mod localization;
mod maps;
pub mod status;
mod streams;

use std::sync::Arc;

use axum::Router;
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, HeaderValue};
use tonic::Extensions;

pub use self::calls::{CALLS, Call, HEALTH_CHECK, call};
pub use self::held::BodyBudget;
use self::proto::job_service_server::JobServiceServer;
use self::proto::localization_service_server::LocalizationServiceServer;
use self::proto::map_service_server::MapServiceServer;
use crate::Metrics;
use whereabouts_api::ErrorKind;
use whereabouts_core::MapName;
use whereabouts_service::{Deadline, Principal, Readiness, Service, ServiceError};

use whereabouts_api::{DESCRIPTOR_SET as CONTRACT, proto};

/// Whether a request is a call of gRPC.
pub fn is_call(headers: &HeaderMap) -> bool {
    let kind = headers.get(CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    kind.starts_with(b"application/grpc")
}

/// What answers the calls of the contract, and those of health and reflection.
#[derive(Clone)]
struct Api {
    door: Readiness,
    metrics: Arc<Metrics>,
}

/// All calls as routes. A message may have so many bytes; who sends more has been refused before.
pub fn routes<S: Clone + Send + Sync + 'static>(
    door: &Readiness,
    metrics: &Arc<Metrics>,
    largest: usize,
) -> Router<S> {
    let api = Api { door: door.clone(), metrics: Arc::clone(metrics) };
    let localization =
        LocalizationServiceServer::new(api.clone()).max_decoding_message_size(largest);
    let maps = MapServiceServer::new(api.clone()).max_decoding_message_size(largest);
    let jobs = JobServiceServer::new(api.clone()).max_decoding_message_size(largest);
    let health = tonic_health::pb::health_server::HealthServer::new(api);
    let mut router = Router::new();
    for Call { path, .. } in CALLS {
        let service = path.split('/').nth(1).unwrap_or_default();
        router = match service {
            "whereabouts.v1.LocalizationService" => {
                router.route_service(path, localization.clone())
            }
            "whereabouts.v1.MapService" => router.route_service(path, maps.clone()),
            "whereabouts.v1.JobService" => router.route_service(path, jobs.clone()),
            _ => router.route_service(path, health.clone()),
        };
    }
    // Which version a client asks for is its own choice.
    match (health::reflection_v1(), health::reflection_v1alpha()) {
        (Ok(v1), Ok(v1alpha)) => router
            .route_service(calls::REFLECTION, v1)
            .route_service(calls::REFLECTION_ALPHA, v1alpha),
        (Err(error), _) | (_, Err(error)) => {
            tracing::error!(%error, "there is no reflection");
            router
        }
    }
}

/// Who asks, and until when.
#[derive(Clone)]
struct Asked {
    service: Arc<Service>,
    metrics: Arc<Metrics>,
    caller: Principal,
    deadline: Deadline,
    held: BodyBudget,
}

impl Api {
    fn asked(&self, extensions: &Extensions) -> Result<Asked, ServiceError> {
        let deadline = extensions.get::<Deadline>().copied().unwrap_or_default();
        // Who has not been let in has no business here.
        let caller = extensions.get::<Principal>().cloned().ok_or_else(|| {
            ServiceError::new(ErrorKind::Internal, "a call was not checked; see the server's log")
        })?;
        let held = extensions.get::<BodyBudget>().cloned().unwrap_or_default();
        let metrics = Arc::clone(&self.metrics);
        Ok(Asked { service: self.door.service()?, metrics, caller, deadline, held })
    }
}

impl Asked {
    /// A map that the caller may use. Every map of a request passes here.
    fn map(&self, name: &str) -> Result<MapName, ServiceError> {
        let map: MapName = name.parse()?;
        self.caller.check_map(&map)?;
        Ok(map)
    }
}
