//! What every request passes before a handler sees it, whatever protocol it speaks: connections and TLS,
//! request ids, bounds on size, time and number, authentication, idempotency keys, and errors.
//!
//! Each route declares a [`RoutePolicy`] where it is registered ([`Routes`]); [`guard`] puts the layers in
//! front of the routes. The gate depends on neither `http` nor `grpc`.

mod audit;
mod auth;
mod body;
mod body_budget;
mod bounds;
mod connections;
mod deadline;
mod encoding;
#[cfg(feature = "grpc")]
pub(crate) mod grpc_status;
mod idempotency;
mod incoming;
#[cfg(feature = "grpc")]
mod messages;
mod observe;
mod policy;
mod problem;
mod rate_limit;
mod request_id;
mod settings;
mod state;
mod status;
mod upload;

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware::{from_fn, from_fn_with_state};
use tower_http::catch_panic::CatchPanicLayer;

pub(crate) use self::body::{read_whole, throw_away, too_large};
#[cfg(feature = "grpc")]
pub(crate) use self::body_budget::BodyBudget;
pub(crate) use self::connections::Connections;
pub(crate) use self::idempotency::{IdempotencyId, LONGEST_KEY};
pub(crate) use self::policy::{Access, MapSource, Policies, RoutePolicy, Routes, Waits};
pub(crate) use self::problem::Problem;
pub use self::settings::ServerSettings;
pub(crate) use self::state::{Gate, GateSettings};
pub(crate) use self::state::{Ready, no_bulk_memory};
pub(crate) use self::upload::BodyPaused;

/// Puts the gate in front of routes. The last layer added sees a request first.
pub(crate) fn guard<S: Clone + Send + Sync + 'static>(routes: Routes<S>, gate: &Gate) -> Router<S> {
    let Routes { router, policies } = routes;
    router
        .fallback(problem::no_such_path)
        .layer(DefaultBodyLimit::max(gate.settings.server.body_limit_bytes))
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(from_fn(policy::refuse_undeclared))
        .layer(from_fn_with_state(gate.clone(), idempotency::replay_or_run))
        .layer(from_fn_with_state(gate.clone(), auth::authorize))
        .layer(from_fn_with_state(gate.clone(), bounds::bound))
        .layer(from_fn(problem::render))
        .layer(from_fn_with_state(gate.clone(), observe::observe))
        .layer(from_fn_with_state(Arc::new(policies), policy::attach))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::extract::Request;
    use axum::http::{Method, StatusCode, header};
    use axum::routing::get;
    use tower::ServiceExt;

    /// Two methods of one path and another path, of which only one route has a policy.
    fn router(keys_required: bool) -> Router {
        let gate =
            Gate::new(GateSettings { keys_required, ..GateSettings::small() }, Arc::default());
        let handler = || get(async || "reached").post(async || "reached");
        let mut routes = Routes::new().get("/declared", RoutePolicy::public(), handler());
        routes.router = routes.router.route("/forgotten", handler());
        guard(routes, &gate)
    }

    async fn answer(
        keys_required: bool,
        method: Method,
        path: &str,
    ) -> (StatusCode, Option<String>) {
        let mut request = Request::new(axum::body::Body::empty());
        (*request.method_mut(), *request.uri_mut()) = (method, path.parse().unwrap());
        let response = router(keys_required).oneshot(request).await.unwrap();
        let allow = response.headers().get(header::ALLOW);
        (response.status(), allow.map(|allow| allow.to_str().unwrap().to_owned()))
    }

    #[tokio::test]
    async fn a_route_without_a_policy_is_refused_even_where_no_keys_are_needed() {
        assert_eq!(answer(false, Method::GET, "/declared").await, (StatusCode::OK, None));
        assert_eq!(answer(false, Method::GET, "/forgotten").await.0, StatusCode::FORBIDDEN);
        let (status, allow) = answer(false, Method::POST, "/declared").await;
        assert_eq!(status, StatusCode::METHOD_NOT_ALLOWED);
        assert_eq!(allow.as_deref(), Some("GET,HEAD"));
        assert_eq!(answer(false, Method::GET, "/nowhere").await.0, StatusCode::NOT_FOUND);
        // Nothing is public by default: with keys, the service that knows them is needed first.
        for (method, path) in [(Method::GET, "/forgotten"), (Method::POST, "/declared")] {
            let (status, _) = answer(true, method, path).await;
            assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{path}");
        }
        assert_eq!(answer(true, Method::HEAD, "/declared").await.0, StatusCode::OK);
    }
}
