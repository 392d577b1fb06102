//! Who asks, and whether they may: API keys, roles, maps, limits, and the audit log.

use std::fmt::Write as _;
use std::sync::Arc;

use axum::RequestExt;
use axum::body::Body;
use axum::extract::{MatchedPath, Query, RawPathParams, Request, State};
use axum::http::header::{AUTHORIZATION, WWW_AUTHENTICATE};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::TryStreamExt;

use super::batch;
use super::guard::{RequestId, answered, hanging_up, throw_away};
use super::problem::{Problem, defect};
use super::state::AppState;
use crate::grpc;
use whereabouts_api::ErrorKind;
use whereabouts_core::{ApiKey, MapName, Role, Token};
use whereabouts_service::{Allowances, Principal, Service, ServiceError};

const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");
const RATE_LIMIT_POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");

/// Who may make a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    /// Everybody: what a load balancer or a newcomer asks.
    Public,
    /// Who has this role.
    Role(Role),
}

/// Who may make a call; `None` for one that is not in the list, which takes an admin.
pub(super) fn access(method: &Method, route: &str) -> Option<Access> {
    let method = if method == Method::HEAD { &Method::GET } else { method };
    Some(match (method.as_str(), route) {
        ("GET", "/" | "/console/{file}" | "/docs" | "/openapi.json" | "/livez" | "/readyz") => {
            Access::Public
        }
        ("GET", "/maps" | "/maps/{map}" | "/jobs/{id}" | "/jobs/{id}/events")
        | ("POST", "/localize") => Access::Role(Role::Robot),
        ("GET", "/jobs" | "/events" | "/usage" | "/metrics")
        | ("POST", "/jobs/{id}/cancel" | "/jobs/{id}/retry")
        | ("GET" | "POST", "/maps/{map}/images")
        | ("POST", batch::PATH)
        | ("GET" | "DELETE", "/maps/{map}/images/{id}")
        | ("GET", "/maps/{map}/images/{id}/content")
        | ("GET", "/jobs/{id}/frame" | "/jobs/{id}/matches/{image}" | "/status") => {
            Access::Role(Role::Operator)
        }
        ("PUT" | "DELETE", "/maps/{map}")
        | ("POST", "/maps/{map}/reindex")
        | ("GET", "/maps/{map}/export")
        | ("PUT" | "POST", "/maps/{map}/import")
        | ("GET" | "POST", "/keys")
        | ("DELETE", "/keys/{id}")
        | ("GET" | "POST", "/webhooks")
        | ("GET" | "DELETE", "/webhooks/{id}")
        | ("GET", "/webhooks/{id}/deliveries")
        | ("POST", "/webhooks/{id}/test" | "/webhooks/{id}/deliveries/{delivery}/redeliver") => {
            Access::Role(Role::Admin)
        }
        _ => return None,
    })
}

/// Lets a request through whose caller may make it.
pub(super) async fn admit(
    State(state): State<AppState>,
    mut request: Request,
    next: Next,
) -> Response {
    // What has no route is answered with 404, whoever asks.
    let route = request.extensions().get::<MatchedPath>().map(|path| path.as_str().to_owned());
    let call = route.as_deref().and_then(grpc::call);
    let needed = match &route {
        None => Access::Public,
        Some(_) if call.is_some() => {
            call.and_then(|call| call.role).map_or(Access::Public, Access::Role)
        }
        Some(route) => access(request.method(), route).unwrap_or(Access::Role(Role::Admin)),
    };
    let Access::Role(role) = needed else { return next.run(request).await };
    if !state.settings.keys_required {
        request.extensions_mut().insert(Principal::Anonymous);
        return next.run(request).await;
    }
    let service = match state.door.service() {
        Ok(service) => service,
        Err(error) => return Problem::from(error).into_response(),
    };
    let key = match holder(&service, request.headers()) {
        Ok(key) => key,
        Err(error) => return refuse(request, error),
    };
    let caller = Principal::ApiKey(Arc::clone(&key));
    let audited = match call {
        Some(call) => call.changes,
        None => {
            let changes = !matches!(*request.method(), Method::GET | Method::HEAD);
            changes && route.as_deref() != Some("/localize")
        }
    };
    let mut audited = audited.then(|| Audited::of(&request, &key));
    let (allowances, taken) = service.keys.limits.take_request(&key).await;
    let allowed = match taken {
        Ok(()) => may_make(&service, &caller, role, &mut request, route.as_deref()).await,
        Err(error) => Err(error),
    };
    let mut response = match allowed {
        Err(error) => {
            let response = refuse(request, error);
            audited.iter_mut().for_each(|audited| audited.answered(&response));
            response
        }
        Ok(()) => {
            request.extensions_mut().insert(caller);
            // What an admin has begun is done, and written down, though the admin has gone.
            let to_the_end =
                audited.is_some() && (role == Role::Admin || request.method() == Method::DELETE);
            let request = counted(request, &service, &key);
            let doing = async move {
                let response = next.run(request).await;
                audited.iter_mut().for_each(|audited| audited.answered(&response));
                response
            };
            match to_the_end {
                false => doing.await,
                true => tokio::spawn(doing).await.unwrap_or_else(|_| defect().into_response()),
            }
        }
    };
    tell(&allowances, response.headers_mut());
    response
}

/// The key that the request was sent with.
fn holder(service: &Service, headers: &HeaderMap) -> Result<Arc<ApiKey>, ServiceError> {
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
    // The text itself is in no error: it may be a key with a slip of the pen.
    let token: Token = token.trim().parse().map_err(|_| unauthorized("the key is unknown"))?;
    service.keys.holder(&token)
}

/// Whether the caller has the role that a call takes, and may use the maps that it is about.
async fn may_make(
    service: &Service,
    caller: &Principal,
    role: Role,
    request: &mut Request,
    route: Option<&str>,
) -> Result<(), ServiceError> {
    let Principal::ApiKey(key) = caller else { return Ok(()) };
    if key.role < role {
        return Err(ServiceError::new(
            ErrorKind::Forbidden,
            format!(
                "this takes the role {role}, and the key {} has the role {}; ask an admin for another key",
                key.id, key.role
            ),
        ));
    }
    let route = route.unwrap_or_default();
    // The map of a call of gRPC is in a message, and checked when that has been read.
    if key.maps.is_empty() || grpc::call(route).is_some() {
        return Ok(());
    }
    let parameters = request.extract_parts::<RawPathParams>().await.ok();
    let parameter = |name: &str| {
        let known = parameters.as_ref()?.iter().find(|(key, _)| *key == name);
        known.map(|(_, value)| value.to_owned())
    };
    let named = match route {
        // The list holds only the maps of the key.
        "/maps" => return Ok(()),
        _ if route.starts_with("/maps/") => parameter("map"),
        _ if route.starts_with("/jobs/") => match parameter("id").and_then(|id| id.parse().ok()) {
            // What is no id, or of no job, the handler says.
            None => return Ok(()),
            Some(id) => match service.jobs.get(id, None).await {
                Ok(job) => Some(job.map.to_string()),
                Err(error) if error.kind == ErrorKind::NotFound => return Ok(()),
                Err(error) => return Err(error),
            },
        },
        "/localize" | "/jobs" | "/events" | "/usage" => {
            query_parameter(request.uri().query().unwrap_or_default(), "map")
        }
        _ => None,
    };
    let map = named.as_deref().map(str::parse::<MapName>);
    match map {
        Some(Ok(map)) => caller.check_map(&map),
        // No map has such a name; the handler says so.
        Some(Err(_)) => Ok(()),
        None => Err(ServiceError::new(
            ErrorKind::Forbidden,
            "this key is for some maps only, and the request is about all; name one with ?map=, or ask an \
             admin for another key",
        )),
    }
}

/// The value of a parameter that is given once.
fn query_parameter(query: &str, name: &str) -> Option<String> {
    let uri: Uri = format!("/?{query}").parse().ok()?;
    // Read as the handlers read it.
    let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(&uri).ok()?;
    let mut values = pairs.into_iter().filter(|(key, _)| key == name).map(|(_, value)| value);
    let value = values.next()?;
    values.next().is_none().then_some(value)
}

/// The request, whose body is counted as it comes.
fn counted(request: Request, service: &Arc<Service>, key: &Arc<ApiKey>) -> Request {
    if key.limits.bytes_per_minute.is_none() {
        return request;
    }
    let (service, key) = (Arc::clone(service), Arc::clone(key));
    request.map(|body| {
        let count = move |chunk: bytes::Bytes| {
            let (service, key) = (Arc::clone(&service), Arc::clone(&key));
            async move {
                service.keys.limits.take_bytes(&key, chunk.len()).await;
                Ok(chunk)
            }
        };
        Body::from_stream(body.into_data_stream().and_then(count))
    })
}

fn refuse(request: Request, error: ServiceError) -> Response {
    let unauthorized = error.kind == ErrorKind::Unauthorized;
    let has_body = !matches!(*request.method(), Method::GET | Method::HEAD | Method::DELETE);
    throw_away(request);
    let problem = Problem::from(error);
    let mut response = if has_body { hanging_up(problem) } else { problem.into_response() };
    if unauthorized {
        let challenge = HeaderValue::from_static("Bearer realm=\"whereabouts\"");
        response.headers_mut().insert(WWW_AUTHENTICATE, challenge);
    }
    response
}

/// Says what is left to the key, as *RateLimit header fields for HTTP* has it
/// (draft-ietf-httpapi-ratelimit-headers-10).
fn tell(allowances: &Allowances, headers: &mut HeaderMap) {
    let (mut policy, mut left) = (String::new(), String::new());
    for (name, unit, allowance) in [
        ("requests", "", allowances.requests),
        ("bytes", ";qu=\"content-bytes\"", allowances.bytes),
    ] {
        let Some(allowance) = allowance else { continue };
        let comma = if policy.is_empty() { "" } else { ", " };
        // Writing to a string does not fail.
        let _ = write!(policy, "{comma}\"{name}\";q={}{unit};w=60", allowance.limit);
        let seconds = allowance.reset.as_secs_f64().ceil();
        let _ = write!(left, "{comma}\"{name}\";r={};t={seconds}", allowance.remaining);
    }
    if policy.is_empty() {
        return;
    }
    for (name, text) in [(RATE_LIMIT_POLICY, policy), (RATE_LIMIT, left)] {
        if let Ok(value) = HeaderValue::from_str(&text) {
            headers.insert(name, value);
        }
    }
}

/// A call that changes something, for the audit log; written down when it ends, however that is.
struct Audited {
    request_id: RequestId,
    key: Arc<ApiKey>,
    method: Method,
    path: String,
    /// `None` as long as there is no answer.
    status: Option<u16>,
}

impl Audited {
    fn of(request: &Request, key: &Arc<ApiKey>) -> Self {
        Self {
            request_id: request.extensions().get::<RequestId>().cloned().unwrap_or_default(),
            key: Arc::clone(key),
            method: request.method().clone(),
            path: without_secrets(request.uri().path()),
            status: None,
        }
    }

    fn answered(&mut self, response: &Response) {
        self.status = Some(answered(response));
    }
}

impl Drop for Audited {
    fn drop(&mut self) {
        let Self { request_id, key, method, path, status } = self;
        tracing::info!(
            target: "audit",
            request_id = %request_id.0, key = %key.id, key_name = %key.name, role = %key.role,
            %method, path, status, "{}", if status.is_some() { "a call" } else { "a call that was given up" }
        );
    }
}

/// A path as it may be logged: somebody may have put a key into it.
pub(super) fn without_secrets(path: &str) -> String {
    match path.find(Token::PREFIX) {
        None => path.to_owned(),
        Some(at) => {
            let shown: String = path[at..].chars().take(Token::PREFIX.len() + Token::ID).collect();
            format!("{}{shown}…", &path[..at])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_call_of_the_description_has_a_role() {
        let description = serde_json::to_value(super::super::openapi()).unwrap();
        let mut calls = 0;
        for (route, methods) in description["paths"].as_object().unwrap() {
            for method in methods.as_object().unwrap().keys() {
                let method: Method = method.to_uppercase().parse().unwrap();
                assert!(access(&method, route).is_some(), "{method} {route}");
                calls += 1;
            }
        }
        assert!(calls > 20);
        assert_eq!(access(&Method::HEAD, "/maps"), Some(Access::Role(Role::Robot)));
        assert_eq!(access(&Method::POST, "/maps/{map}/nonsense"), None);
    }

    #[test]
    fn a_key_in_a_path_is_not_logged() {
        let token = Token::new(&[0xa7; 38]);
        let logged = without_secrets(&format!("/keys/{}/x", token.reveal()));
        assert_eq!(logged, "/keys/wab_a7a7a7a7a7a7…");
        assert_eq!(without_secrets("/maps/yard"), "/maps/yard");
    }

    #[test]
    fn a_map_is_read_from_a_query_only_if_it_is_named_once() {
        assert_eq!(query_parameter("map=a%20b&k=1", "map"), Some("a b".into()));
        assert_eq!(query_parameter("map=a&map=b", "map"), None);
        assert_eq!(query_parameter("k=1", "map"), None);
        assert_eq!(query_parameter("", "map"), None);
    }

    #[test]
    fn what_is_left_is_told_in_the_standard_form() {
        let requests = whereabouts_service::Allowance {
            limit: 600,
            remaining: 12,
            reset: std::time::Duration::from_millis(58_800),
        };
        let bytes = whereabouts_service::Allowance { limit: 1_000_000, remaining: 0, ..requests };
        let mut headers = HeaderMap::new();
        tell(&Allowances { requests: Some(requests), bytes: Some(bytes) }, &mut headers);
        assert_eq!(
            headers["ratelimit-policy"],
            "\"requests\";q=600;w=60, \"bytes\";q=1000000;qu=\"content-bytes\";w=60"
        );
        assert_eq!(headers["ratelimit"], "\"requests\";r=12;t=59, \"bytes\";r=0;t=59");
        let mut none = HeaderMap::new();
        tell(&Allowances::default(), &mut none);
        assert!(none.is_empty());
    }
}
