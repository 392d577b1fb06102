//! HTTP: extracts a request, calls the service, converts the answer. Decides nothing about maps or frames.

mod batch;
mod body;
mod description;
mod descriptions;
mod events;
mod examples;
mod health;
mod images;
mod jobs;
mod keys;
mod localize;
mod maps;
mod pixels;
mod state;
mod status;
mod tracks;
mod transfer;
mod usage;
mod webhooks;
mod words;

use axum::extract::DefaultBodyLimit;
use axum::http::Method;
use axum::routing::get;
use utoipa::OpenApi;
use utoipa_axum::router::{OpenApiRouter, UtoipaMethodRouter, UtoipaMethodRouterExt};
use utoipa_axum::routes;

use crate::gate::{MapSource, Policies, RoutePolicy, Routes, Waits};

pub use self::examples::{Captured, Example, ExampleBody, ExamplePart, examples};
pub use self::state::Tiles;
pub(crate) use self::state::{About, AppState};

#[derive(OpenApi)]
#[openapi(
    info(
        title = "whereabouts",
        description = "Tells a robot where it is from one camera frame. Maps of reference images \
                       are searched by global descriptor; a job then compares the frame with each \
                       candidate and ranks them again. Errors are RFC 9457 problems.",
        license(name = "Apache-2.0", identifier = "Apache-2.0")
    ),
    components(schemas(
        crate::gate::Problem,
        whereabouts_api::JobChange,
        whereabouts_api::JobStatus,
        whereabouts_api::Missed,
        whereabouts_api::RefineMode,
        whereabouts_api::PairDescribed
    )),
    tags(
        (name = "maps", description = "Named sets of reference images"),
        (name = "images", description = "Reference images with their poses"),
        (name = "localize", description = "Find the candidates of a frame"),
        (name = "jobs", description = "Refine the ranking of the candidates"),
        (name = "keys", description = "API keys, where the server requires them"),
        (name = "webhooks", description = "URLs that are notified when jobs end"),
        (name = "service", description = "Health, metrics and this description")
    )
)]
struct Description;

/// Routes with their descriptions and policies.
struct Described {
    router: OpenApiRouter<AppState>,
    policies: Policies,
}

impl Described {
    /// Adds a handler, whose method and path are those of its description.
    fn route(mut self, policy: RoutePolicy, route: UtoipaMethodRouter<AppState>) -> Self {
        for (path, item) in &route.1.paths {
            let operations = [
                (Method::GET, &item.get),
                (Method::PUT, &item.put),
                (Method::POST, &item.post),
                (Method::PATCH, &item.patch),
                (Method::DELETE, &item.delete),
            ];
            for (method, operation) in operations {
                if operation.is_some() {
                    self.policies.declare(Some(method), path, policy);
                }
            }
        }
        Self { router: self.router.routes(route), ..self }
    }
}

/// The routes that the description covers: one line says what the gate needs to know about each.
fn described() -> Described {
    let (public, robot) = (RoutePolicy::public(), RoutePolicy::robot());
    let (operator, admin) = (RoutePolicy::operator(), RoutePolicy::admin());
    let batch = routes!(batch::add_images).layer(DefaultBodyLimit::disable());
    let waits_for_job = Waits::WithQueryValue("refine", "wait");
    Described {
        router: OpenApiRouter::with_openapi(Description::openapi()),
        policies: Policies::default(),
    }
    .route(robot.map(MapSource::Handler), routes!(maps::list_maps))
    .route(robot.map(MapSource::Path), routes!(maps::get_map))
    .route(admin.map(MapSource::Path).changes(), routes!(maps::put_map))
    .route(admin.map(MapSource::Path).changes(), routes!(maps::delete_map))
    .route(admin.map(MapSource::Path).changes().idempotent(), routes!(maps::reindex))
    .route(admin.map(MapSource::Path), routes!(transfer::export))
    .route(admin.map(MapSource::Path), routes!(transfer::vocabulary))
    .route(admin.map(MapSource::Path).changes(), routes!(transfer::import_map))
    .route(admin.map(MapSource::Path).changes().idempotent(), routes!(transfer::import_image))
    .route(operator.map(MapSource::Path), routes!(images::list_images))
    .route(operator.map(MapSource::Path).changes().idempotent(), routes!(images::add_image))
    .route(operator.map(MapSource::Path).changes().bulk(), batch)
    .route(operator.map(MapSource::Path), routes!(images::get_image))
    .route(operator.map(MapSource::Path).changes(), routes!(images::update_image))
    .route(operator.map(MapSource::Path).changes(), routes!(images::delete_image))
    .route(operator.map(MapSource::Path), routes!(images::image_content))
    .route(
        robot.map(MapSource::Query).idempotent().waits(waits_for_job).localizes(),
        routes!(localize::localize),
    )
    .route(operator.map(MapSource::Path), routes!(tracks::list_tracks))
    .route(robot.map(MapSource::Path), routes!(tracks::get_track))
    .route(operator.map(MapSource::Query), routes!(jobs::list_jobs))
    .route(robot.map(MapSource::Job).waits(Waits::WithQuery("wait")), routes!(jobs::get_job))
    .route(operator.map(MapSource::Job), routes!(jobs::frame))
    .route(operator.map(MapSource::Job), routes!(jobs::matches))
    .route(operator.map(MapSource::Job).changes().idempotent(), routes!(jobs::cancel_job))
    .route(operator.map(MapSource::Job).changes().idempotent(), routes!(jobs::retry_job))
    .route(robot.map(MapSource::Job), routes!(events::follow_job))
    .route(operator.map(MapSource::Query), routes!(events::follow_jobs))
    .route(operator.map(MapSource::Query), routes!(usage::usage))
    .route(admin, routes!(descriptions::list_descriptions))
    .route(admin, routes!(descriptions::get_description))
    .route(admin.changes(), routes!(descriptions::remove_description))
    .route(admin.changes(), routes!(descriptions::purge_descriptions))
    .route(operator, routes!(status::status))
    .route(admin.changes(), routes!(keys::create_key))
    .route(admin, routes!(keys::list_keys))
    .route(admin.changes(), routes!(keys::revoke_key))
    .route(admin, routes!(webhooks::list_webhooks))
    .route(admin.changes(), routes!(webhooks::create_webhook))
    .route(admin, routes!(webhooks::get_webhook))
    .route(admin.changes(), routes!(webhooks::delete_webhook))
    .route(admin.changes().idempotent(), routes!(webhooks::test_webhook))
    .route(admin, routes!(webhooks::list_deliveries))
    .route(admin.changes().idempotent(), routes!(webhooks::redeliver))
    .route(public.probe(), routes!(health::livez))
    .route(public.probe(), routes!(health::readyz))
    .route(operator.probe(), routes!(health::metrics))
}

/// The OpenAPI 3.1 description, generated from the handlers.
pub fn openapi() -> utoipa::openapi::OpenApi {
    let Described { router, policies } = described();
    description::completed(router.into_openapi(), &policies)
}

/// All routes of HTTP but those of the console.
pub(crate) fn routes() -> Routes<AppState> {
    let Described { router, policies } = described();
    let (router, description) = router.split_for_parts();
    let description = description::completed(description, &policies);
    Routes { router, policies }
        .get("/openapi.json", RoutePolicy::public(), get(move || health::openapi_json(description)))
        .get("/docs", RoutePolicy::public(), get(health::docs))
}

/// Says at `/` that there is no page, in a build without the console.
#[cfg(not(feature = "console"))]
pub(crate) fn without_console() -> Routes<AppState> {
    const TEXT: &str = "This server was built without the operator's console (cargo feature `console`). \
                        GET /docs lists the calls.\n";
    Routes::new().get("/", RoutePolicy::public(), get(async || TEXT))
}

/// The routes of a process that only refines: whether it is alive and ready, and its metrics.
pub(crate) fn worker_routes() -> Routes<AppState> {
    Routes::new()
        .get("/livez", RoutePolicy::public().probe(), get(health::livez))
        .get("/readyz", RoutePolicy::public().probe(), get(health::readyz))
        .get("/metrics", RoutePolicy::operator().probe(), get(health::metrics))
}

/// Whether a request is a form that an upload accepts: a part `image`, and optionally one `meta`. For fuzzing.
pub async fn is_picture_form(request: axum::extract::Request) -> bool {
    body::from_form(request, usize::MAX).await.is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Collects all references within a description.
    fn references(value: &serde_json::Value, found: &mut Vec<String>) {
        match value {
            serde_json::Value::Object(fields) => {
                if let Some(reference) = fields.get("$ref").and_then(|value| value.as_str()) {
                    found.push(reference.to_owned());
                }
                fields.values().for_each(|value| references(value, found));
            }
            serde_json::Value::Array(items) => {
                items.iter().for_each(|value| references(value, found));
            }
            _ => {}
        }
    }

    #[test]
    fn every_reference_of_the_description_resolves() {
        let description = serde_json::to_value(openapi()).unwrap();
        let mut found = Vec::new();
        references(&description, &mut found);
        assert!(found.len() > 100);
        for reference in found {
            let pointer = reference.strip_prefix('#').unwrap();
            assert!(description.pointer(pointer).is_some(), "{reference}");
        }
    }

    #[test]
    fn every_described_call_has_a_policy_and_every_post_says_whether_it_can_be_replayed() {
        let Described { policies, .. } = described();
        let description = serde_json::to_value(openapi()).unwrap();
        let (mut calls, mut without_replay) = (0, Vec::new());
        for (path, methods) in description["paths"].as_object().unwrap() {
            for method in methods.as_object().unwrap().keys() {
                let method: Method = method.to_uppercase().parse().unwrap();
                let policy = policies.of(&method, path).unwrap();
                calls += 1;
                assert!(!policy.is_grpc() && (policy.streams == policy.bulk));
                if method == Method::POST && !policy.idempotent {
                    without_replay.push(path.clone());
                }
                let reads = method == Method::GET || policy.localizes;
                assert_eq!(policy.changes, !reads, "{method} {path}");
            }
        }
        assert!(calls > 20);
        without_replay.sort();
        assert_eq!(without_replay, ["/keys", "/maps/{map}/images:batch", "/webhooks"]);
    }
}
