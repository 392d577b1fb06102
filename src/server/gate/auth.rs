//! Authentication by API key, and authorization by role and map.

use std::sync::Arc;

use axum::RequestExt;
use axum::extract::{RawPathParams, Request, State};
use axum::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::audit::AuditEntry;
use super::body::{closing, throw_away};
use super::policy::{Access, MapSource, RouteMatch, RoutePolicy, query_parameter};
use super::problem::{Problem, defect};
use super::rate_limit;
use super::state::Gate;
use whereabouts_api::ErrorKind;
use whereabouts_core::{ApiKey, MapName, Role, Token};
use whereabouts_service::{Principal, Service, ServiceError};

/// Lets a request through whose caller may make it.
pub(super) async fn authorize(
    State(gate): State<Gate>,
    mut request: Request,
    next: Next,
) -> Response {
    let policy = match request.extensions().get() {
        // A path without a route is answered 404 to every caller.
        None => return next.run(request).await,
        Some(RouteMatch::Declared(policy)) => *policy,
        // Refused below, and only an admin learns how.
        Some(RouteMatch::Undeclared { .. }) => RoutePolicy::admin().changes(),
    };
    let Access::Role(role) = policy.access else { return next.run(request).await };
    if !gate.settings.keys_required {
        request.extensions_mut().insert(Principal::Anonymous);
        return next.run(request).await;
    }
    let service = match gate.readiness.service() {
        Ok(service) => service,
        Err(error) => return Problem::from(error).into_response(),
    };
    let key = match authenticate(&service, request.headers()) {
        Ok(key) => key,
        Err(error) => return refuse(request, error),
    };
    let caller = Principal::ApiKey(Arc::clone(&key));
    let mut audit = policy.changes.then(|| AuditEntry::of(&request, &key));
    let (allowances, within_limit) = service.keys.limits.take_request(&key).await;
    let allowed = match within_limit {
        Ok(()) => check(&service, &caller, role, policy.map, &mut request).await,
        Err(error) => Err(error),
    };
    let mut response = match allowed {
        Err(error) => {
            let response = refuse(request, error);
            audit.iter_mut().for_each(|entry| entry.answered(&response));
            response
        }
        Ok(()) => {
            request.extensions_mut().insert(caller);
            // What an admin has started is finished and logged, even if the client disconnects.
            let detached =
                audit.is_some() && (role == Role::Admin || request.method() == Method::DELETE);
            let request = rate_limit::charge_body(request, &service, &key);
            let answer = async move {
                let response = next.run(request).await;
                audit.iter_mut().for_each(|entry| entry.answered(&response));
                response
            };
            match detached {
                false => answer.await,
                true => tokio::spawn(answer).await.unwrap_or_else(|_| defect().into_response()),
            }
        }
    };
    rate_limit::write_headers(&allowances, response.headers_mut());
    response
}

/// The key that the request was sent with.
fn authenticate(service: &Service, headers: &HeaderMap) -> Result<Arc<ApiKey>, ServiceError> {
    let unauthorized = |detail: &str| ServiceError::new(ErrorKind::Unauthorized, detail);
    let mut sent = headers.get_all(AUTHORIZATION).iter();
    let Some(header) = sent.next() else {
        return Err(unauthorized(
            "a key is needed: send it as \"Authorization: Bearer wab_…\"; `whereabouts keys create` makes \
             one",
        ));
    };
    if sent.next().is_some() {
        return Err(unauthorized("the request has two Authorization headers; send one"));
    }
    let (scheme, token) =
        header.to_str().ok().and_then(|text| text.split_once(' ')).unwrap_or_default();
    if !scheme.eq_ignore_ascii_case("bearer") {
        return Err(unauthorized("send the key as \"Authorization: Bearer wab_…\""));
    }
    // The error does not repeat the text, which may be a real key with a typing error.
    let token: Token = token.trim().parse().map_err(|_| unauthorized("the key is unknown"))?;
    service.keys.holder(&token)
}

/// Checks that the caller has the role of the route, and may use the map that the request is about.
async fn check(
    service: &Service,
    caller: &Principal,
    role: Role,
    source: MapSource,
    request: &mut Request,
) -> Result<(), ServiceError> {
    let Principal::ApiKey(key) = caller else { return Ok(()) };
    if key.role < role {
        return Err(ServiceError::new(
            ErrorKind::Forbidden,
            format!(
                "this call requires the role {role}, but the key {} has the role {}; ask an admin for another key",
                key.id, key.role
            ),
        ));
    }
    if key.maps.is_empty() {
        return Ok(());
    }
    let map = match source {
        MapSource::Handler => return Ok(()),
        MapSource::AllMaps => None,
        MapSource::Path => path_parameter(request, "map").await,
        MapSource::Query => query_parameter(request.uri(), "map"),
        MapSource::Job => {
            let id = path_parameter(request, "id").await.and_then(|id| id.parse().ok());
            // The handler answers 404 for an id that is malformed or unknown.
            let Some(id) = id else { return Ok(()) };
            match service.get_job(id, None).await {
                Ok(job) => Some(job.map.to_string()),
                Err(error) if error.kind == ErrorKind::NotFound => return Ok(()),
                Err(error) => return Err(error),
            }
        }
    };
    match map.as_deref().map(str::parse::<MapName>) {
        Some(Ok(map)) => caller.check_map(&map),
        // No map can have such a name; the handler answers so.
        Some(Err(_)) => Ok(()),
        None => Err(ServiceError::new(
            ErrorKind::Forbidden,
            "this key is restricted to some maps, but the request is about all; name one with ?map=, or ask an \
             admin for another key",
        )),
    }
}

async fn path_parameter(request: &mut Request, name: &str) -> Option<String> {
    let parameters = request.extract_parts::<RawPathParams>().await.ok()?;
    let found = parameters.iter().find(|(key, _)| *key == name);
    found.map(|(_, value)| value.to_owned())
}

fn refuse(request: Request, error: ServiceError) -> Response {
    let unauthorized = error.kind == ErrorKind::Unauthorized;
    let has_body = !matches!(*request.method(), Method::GET | Method::HEAD | Method::DELETE);
    throw_away(request);
    let problem = Problem::from(error);
    let mut response = if has_body { closing(problem) } else { problem.into_response() };
    if unauthorized {
        let challenge = HeaderValue::from_static("Bearer realm=\"whereabouts\"");
        response.headers_mut().insert(WWW_AUTHENTICATE, challenge);
    }
    response
}
