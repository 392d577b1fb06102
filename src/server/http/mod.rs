//! HTTP: extract, call the service, convert. No decision about maps or frames is taken here.

mod auth;
mod batch;
mod body;
mod connections;
mod deadline;
mod description;
mod events;
mod examples;
mod guard;
mod health;
mod idempotency;
mod images;
mod incoming;
mod jobs;
mod keys;
mod localize;
mod maps;
mod messages;
mod problem;
mod state;
mod status;
mod transfer;
mod usage;
mod webhooks;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware::{from_fn, from_fn_with_state};
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::OpenApi;
use utoipa_axum::router::{OpenApiRouter, UtoipaMethodRouterExt};
use utoipa_axum::routes;

use crate::grpc;

pub use connections::{ConnectionSettings, Connections, Tls, TlsError};
pub use examples::{Example, ExampleBody, ExamplePart, Taken, examples};
pub use state::{AppState, HttpSettings};
pub use status::{About, Tiles};

#[derive(OpenApi)]
#[openapi(
    info(
        title = "whereabouts",
        description = "Tells a robot where it is from one camera frame. Maps of reference images \
                       are searched by global descriptor; a job then compares the frame with each \
                       candidate and orders them anew. Errors are RFC 9457 problems.",
        license(name = "Apache-2.0", identifier = "Apache-2.0")
    ),
    components(schemas(
        problem::Problem,
        whereabouts_api::JobChange,
        whereabouts_api::JobStatus,
        whereabouts_api::Missed,
        whereabouts_api::RefineMode,
        whereabouts_api::PairDescribed
    )),
    tags(
        (name = "maps", description = "Named sets of reference images"),
        (name = "images", description = "Reference images with their poses"),
        (name = "localize", description = "From a frame to candidates"),
        (name = "jobs", description = "Refinements of the candidates"),
        (name = "keys", description = "API keys, where the server asks for them"),
        (name = "webhooks", description = "Who is told of the ends of jobs"),
        (name = "service", description = "Health, metrics and this description")
    )
)]
struct Description;

fn described() -> OpenApiRouter<AppState> {
    OpenApiRouter::with_openapi(Description::openapi())
        .routes(routes!(maps::list_maps))
        .routes(routes!(maps::get_map, maps::put_map, maps::delete_map))
        .routes(routes!(maps::reindex))
        .routes(routes!(transfer::export))
        .routes(routes!(transfer::import_map, transfer::import_image))
        .routes(routes!(images::list_images, images::add_image))
        .routes(routes!(batch::add_images).layer(DefaultBodyLimit::disable()))
        .routes(routes!(images::get_image, images::delete_image))
        .routes(routes!(images::image_content))
        .routes(routes!(localize::localize))
        .routes(routes!(jobs::list_jobs))
        .routes(routes!(jobs::get_job))
        .routes(routes!(jobs::frame))
        .routes(routes!(jobs::matches))
        .routes(routes!(jobs::cancel_job))
        .routes(routes!(jobs::retry_job))
        .routes(routes!(events::follow_job))
        .routes(routes!(events::follow_jobs))
        .routes(routes!(usage::usage))
        .routes(routes!(status::status))
        .routes(routes!(keys::create_key, keys::list_keys))
        .routes(routes!(keys::revoke_key))
        .routes(routes!(webhooks::list_webhooks, webhooks::create_webhook))
        .routes(routes!(webhooks::get_webhook, webhooks::delete_webhook))
        .routes(routes!(webhooks::test_webhook))
        .routes(routes!(webhooks::list_deliveries))
        .routes(routes!(webhooks::redeliver))
        .routes(routes!(health::livez))
        .routes(routes!(health::readyz))
        .routes(routes!(health::metrics))
}

/// The OpenAPI 3.1 description, generated from the handlers.
pub fn openapi() -> utoipa::openapi::OpenApi {
    description::completed(described().into_openapi())
}

/// All routes with what guards them.
pub fn router(state: AppState) -> Router {
    let (router, description) = described().split_for_parts();
    let description = description::completed(description);
    router
        .merge(grpc::routes(&state.door, &state.metrics, state.settings.body_limit_bytes))
        .route("/openapi.json", axum::routing::get(move || health::openapi_json(description)))
        .route("/docs", axum::routing::get(health::docs))
        .merge(crate::console::routes(state.about.tiles.as_ref().map(|tiles| tiles.url.as_str())))
        .fallback(problem::no_such_path)
        .method_not_allowed_fallback(problem::no_such_method)
        .layer(DefaultBodyLimit::max(state.settings.body_limit_bytes))
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(from_fn_with_state(state.clone(), idempotency::once))
        .layer(from_fn_with_state(state.clone(), auth::admit))
        .layer(from_fn_with_state(state.clone(), guard::bound))
        .layer(from_fn(problem::render))
        .layer(from_fn_with_state(state.clone(), guard::observe))
        .with_state(state)
}

/// What a process answers that only refines: whether it is alive and ready, and its metrics.
pub fn worker_router(state: AppState) -> Router {
    Router::new()
        .route("/livez", axum::routing::get(health::livez))
        .route("/readyz", axum::routing::get(health::readyz))
        .route("/metrics", axum::routing::get(health::metrics))
        .fallback(problem::no_such_path)
        .method_not_allowed_fallback(problem::no_such_method)
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(from_fn_with_state(state.clone(), auth::admit))
        .layer(from_fn_with_state(state.clone(), guard::bound))
        .layer(from_fn(problem::render))
        .layer(from_fn_with_state(state.clone(), guard::observe))
        .with_state(state)
}

/// Whether a request is a form that an upload can be: a part `image`, and perhaps one `meta`.
pub async fn is_picture_form(request: axum::extract::Request) -> bool {
    body::from_form(request, usize::MAX).await.is_ok()
}

#[cfg(test)]
mod tests {
    /// All that a description refers to.
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
    fn the_description_refers_to_nothing_that_is_not_there() {
        let description = serde_json::to_value(super::openapi()).unwrap();
        let mut found = Vec::new();
        references(&description, &mut found);
        assert!(found.len() > 100);
        for reference in found {
            let place = reference.strip_prefix('#').unwrap();
            assert!(description.pointer(place).is_some(), "{reference}");
        }
    }
}
