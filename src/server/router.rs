//! Puts the routes of all protocols behind one gate.

use axum::Router;

#[cfg(feature = "console")]
use crate::console;
use crate::gate;
#[cfg(feature = "grpc")]
use crate::grpc;
use crate::http::{self, AppState};

/// All routes of a server.
pub(crate) fn router(state: AppState) -> Router {
    let routes = http::routes();
    #[cfg(feature = "grpc")]
    let routes = routes.merge(grpc::routes(&state.gate));
    #[cfg(feature = "console")]
    let routes =
        routes.merge(console::routes(state.about.tiles.as_ref().map(|tiles| tiles.url.as_str())));
    #[cfg(not(feature = "console"))]
    let routes = routes.merge(http::without_console());
    gate::guard(routes, &state.gate).with_state(state)
}

/// The routes of a process that only refines.
pub(crate) fn worker_router(state: AppState) -> Router {
    gate::guard(http::worker_routes(), &state.gate).with_state(state)
}
