//! What the gate needs to know about each route: one [`RoutePolicy`], declared where the route is registered.

use std::collections::HashMap;
#[cfg(feature = "grpc")]
use std::convert::Infallible;
use std::sync::Arc;

use axum::Router;
use axum::extract::{MatchedPath, Query, Request, State};
use axum::http::{Method, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::routing::MethodRouter;
use whereabouts_core::Role;

use super::problem::Problem;
use whereabouts_api::ErrorKind;

/// Who may call a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Access {
    /// Anyone, without a key: what a load balancer or a newcomer asks for.
    Public,
    /// Holders of a key with this role or a higher one.
    Role(Role),
}

/// Where a request names its map, which a key that is restricted to some maps must include.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MapSource {
    /// Nowhere: the request is about all maps, and a restricted key is refused.
    AllMaps,
    /// The path parameter `map`.
    Path,
    /// The query parameter `map`.
    Query,
    /// The job whose id is the path parameter `id`.
    Job,
    /// The messages of a call, or each item of a list: the handler checks.
    Handler,
}

/// Which requests wait for a job, and therefore get `jobs.max_wait_s` on top of `server.request_timeout_s`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Waits {
    /// None.
    Never,
    /// All: whether a call waits is in its message, which has not arrived yet.
    #[cfg_attr(not(feature = "grpc"), expect(dead_code, reason = "only calls of gRPC"))]
    Always,
    /// Those that have this query parameter.
    WithQuery(&'static str),
    /// Those whose query parameter has this value.
    WithQueryValue(&'static str, &'static str),
}

impl Waits {
    /// Whether this request may wait for a job.
    pub fn apply_to(self, uri: &Uri) -> bool {
        match self {
            Self::Never => false,
            Self::Always => true,
            Self::WithQuery(name) => query_parameter(uri, name).is_some(),
            Self::WithQueryValue(name, value) => {
                query_parameter(uri, name).is_some_and(|given| given == value)
            }
        }
    }
}

/// The protocol of a route, which decides how its body is framed and how its errors are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Protocol {
    Http,
    #[cfg(feature = "grpc")]
    Grpc,
}

/// What the gate needs to know about a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RoutePolicy {
    /// How its body is framed and its errors are written.
    pub protocol: Protocol,
    /// Who may call it.
    pub access: Access,
    /// Where a request names its map.
    pub map: MapSource,
    /// Whether its answer is stored for an `Idempotency-Key`. Not where the answer holds a secret, and not
    /// where the body is too large to read in advance.
    pub idempotent: bool,
    /// Which requests may wait for a job.
    pub waits: Waits,
    /// Whether it may take any time: it is bounded by the pauses within its body and by
    /// `server.max_streams`, rather than by a timeout and `server.max_requests`.
    pub streams: bool,
    /// Whether its messages carry pictures; others are bounded to 64 KiB. gRPC calls only.
    pub pictures: bool,
    /// Whether it is a bulk upload, whose memory is that of `bulk.memory_bytes`.
    pub bulk: bool,
    /// Whether it answers with a localized frame, whose latency is in the statistics of the last hour.
    pub localizes: bool,
    /// Whether it changes something that the audit log records.
    pub changes: bool,
    /// Whether it is answered by an overloaded server too, for probes and operators.
    pub probe: bool,
}

impl RoutePolicy {
    const fn new(access: Access) -> Self {
        Self {
            protocol: Protocol::Http,
            access,
            map: MapSource::AllMaps,
            idempotent: false,
            waits: Waits::Never,
            streams: false,
            pictures: false,
            bulk: false,
            localizes: false,
            changes: false,
            probe: false,
        }
    }

    /// Anyone may call.
    pub const fn public() -> Self {
        Self::new(Access::Public)
    }

    /// Takes the role `robot`.
    pub const fn robot() -> Self {
        Self::new(Access::Role(Role::Robot))
    }

    /// Takes the role `operator`.
    pub const fn operator() -> Self {
        Self::new(Access::Role(Role::Operator))
    }

    /// Takes the role `admin`.
    pub const fn admin() -> Self {
        Self::new(Access::Role(Role::Admin))
    }

    /// The same, where the map of a request is named there.
    pub const fn map(self, map: MapSource) -> Self {
        Self { map, ..self }
    }

    /// The same, with stored answers for an `Idempotency-Key`.
    pub const fn idempotent(self) -> Self {
        Self { idempotent: true, ..self }
    }

    /// The same, where these requests may wait for a job.
    pub const fn waits(self, waits: Waits) -> Self {
        Self { waits, ..self }
    }

    /// The same, of a bulk upload.
    pub const fn bulk(self) -> Self {
        Self { bulk: true, streams: true, ..self }
    }

    /// The same, answering with a localized frame.
    pub const fn localizes(self) -> Self {
        Self { localizes: true, ..self }
    }

    /// The same, recorded by the audit log.
    pub const fn changes(self) -> Self {
        Self { changes: true, ..self }
    }

    /// The same, answered by an overloaded server too.
    pub const fn probe(self) -> Self {
        Self { probe: true, ..self }
    }

    /// Whether it is a call of gRPC.
    pub fn is_grpc(&self) -> bool {
        self.protocol != Protocol::Http
    }
}

#[cfg(feature = "grpc")]
impl RoutePolicy {
    /// The same, as a call of gRPC, whose maps are in its messages.
    pub const fn grpc(self) -> Self {
        Self { protocol: Protocol::Grpc, map: MapSource::Handler, ..self }
    }

    /// The same, for any length of time.
    pub const fn streams(self) -> Self {
        Self { streams: true, ..self }
    }

    /// The same, with pictures in its messages.
    pub const fn pictures(self) -> Self {
        Self { pictures: true, ..self }
    }
}

/// The policies of all routes, by path and method.
#[derive(Debug, Clone, Default)]
pub(crate) struct Policies {
    by_path: HashMap<String, Vec<(Option<Method>, RoutePolicy)>>,
}

impl Policies {
    /// Declares the policy of a route; `None` stands for every method.
    pub fn declare(&mut self, method: Option<Method>, path: &str, policy: RoutePolicy) {
        self.by_path.entry(path.to_owned()).or_default().push((method, policy));
    }

    /// The policy of a route. `HEAD` has that of `GET`, whose handler answers it.
    pub fn of(&self, method: &Method, path: &str) -> Option<RoutePolicy> {
        let method = if method == Method::HEAD { &Method::GET } else { method };
        let of_path = self.by_path.get(path)?;
        let found = of_path.iter().find(|(of, _)| of.as_ref().is_none_or(|of| of == method));
        found.map(|(_, policy)| *policy)
    }

    fn match_request(&self, request: &Request) -> Option<RouteMatch> {
        let path = request.extensions().get::<MatchedPath>()?.as_str();
        Some(match self.of(request.method(), path) {
            Some(policy) => RouteMatch::Declared(policy),
            None => RouteMatch::Undeclared { allowed: self.allowed_methods(path) },
        })
    }

    /// The methods that are declared for a path, as the header `Allow` lists them.
    fn allowed_methods(&self, path: &str) -> Option<String> {
        let methods = self.by_path.get(path)?.iter().filter_map(|(method, _)| method.as_ref());
        let names = methods.map(|method| match *method {
            Method::GET => "GET,HEAD",
            _ => method.as_str(),
        });
        Some(names.collect::<Vec<_>>().join(","))
    }
}

/// Routes, each registered together with its policy.
pub(crate) struct Routes<S> {
    pub router: Router<S>,
    pub policies: Policies,
}

impl<S: Clone + Send + Sync + 'static> Routes<S> {
    pub fn new() -> Self {
        Self { router: Router::new(), policies: Policies::default() }
    }

    /// Adds a route that answers `GET`.
    pub fn get(mut self, path: &str, policy: RoutePolicy, handler: MethodRouter<S>) -> Self {
        self.policies.declare(Some(Method::GET), path, policy);
        Self { router: self.router.route(path, handler), ..self }
    }

    /// Adds a call of gRPC.
    #[cfg(feature = "grpc")]
    pub fn call<T>(mut self, path: &str, policy: RoutePolicy, service: T) -> Self
    where
        T: tower::Service<Request, Error = Infallible> + Clone + Send + Sync + 'static,
        T::Response: IntoResponse,
        T::Future: Send + 'static,
    {
        // The gate checks the media type of a call, and tonic its method.
        self.policies.declare(None, path, policy);
        Self { router: self.router.route_service(path, service), ..self }
    }

    /// Adds all routes of another set; their paths must differ.
    pub fn merge(mut self, others: Self) -> Self {
        self.policies.by_path.extend(others.policies.by_path);
        Self { router: self.router.merge(others.router), ..self }
    }
}

/// What the policies say about a request that matches a route; inserted into its extensions by [`attach`].
#[derive(Debug, Clone)]
pub(super) enum RouteMatch {
    Declared(RoutePolicy),
    /// There is none: the request is refused. `allowed` are the methods declared for its path, if there
    /// are any.
    Undeclared {
        allowed: Option<String>,
    },
}

/// Looks up the policy of each request, for all layers below.
pub(super) async fn attach(
    State(policies): State<Arc<Policies>>,
    mut request: Request,
    next: Next,
) -> Response {
    if let Some(found) = policies.match_request(&request) {
        request.extensions_mut().insert(found);
    }
    next.run(request).await
}

/// The policy of a request that passed [`attach`].
pub(super) fn policy(request: &Request) -> Option<RoutePolicy> {
    match request.extensions().get() {
        Some(RouteMatch::Declared(policy)) => Some(*policy),
        _ => None,
    }
}

/// Refuses requests to a route without a policy, so that one that was forgotten is closed to everyone.
pub(super) async fn refuse_undeclared(request: Request, next: Next) -> Response {
    match request.extensions().get() {
        Some(RouteMatch::Undeclared { allowed: Some(allowed) }) => {
            Problem::method_not_allowed(&request, allowed)
        }
        Some(RouteMatch::Undeclared { allowed: None }) => {
            let path = request.uri().path();
            tracing::error!(path, "a route has no policy");
            let detail = format!("{path} is closed: no policy says who may call it");
            Problem::new(ErrorKind::Forbidden, detail).into_response()
        }
        _ => next.run(request).await,
    }
}

/// The value of a query parameter, if it is given exactly once. Decoded as the handlers decode it.
pub(super) fn query_parameter(uri: &Uri, name: &str) -> Option<String> {
    let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri).ok()?;
    let mut values = pairs.into_iter().filter(|(key, _)| key == name).map(|(_, value)| value);
    let value = values.next()?;
    values.next().is_none().then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uri(query: &str) -> Uri {
        format!("/?{query}").parse().unwrap()
    }

    #[test]
    fn a_map_is_read_from_a_query_only_if_it_is_named_once() {
        assert_eq!(query_parameter(&uri("map=a%20b&k=1"), "map"), Some("a b".into()));
        assert_eq!(query_parameter(&uri("map=a&map=b"), "map"), None);
        assert_eq!(query_parameter(&uri("k=1"), "map"), None);
        assert_eq!(query_parameter(&uri(""), "map"), None);
    }

    #[test]
    fn only_the_declared_parameter_extends_the_timeout() {
        let localize = Waits::WithQueryValue("refine", "wait");
        assert!(localize.apply_to(&uri("map=yard&refine=wait")));
        assert!(localize.apply_to(&uri("refine=%77ait&map=yard")));
        for query in ["map=waiting-room", "map=yard&refine=async", "map=yard&track=wait", "wait=5"]
        {
            assert!(!localize.apply_to(&uri(query)), "{query}");
        }
        let job = Waits::WithQuery("wait");
        assert!(job.apply_to(&uri("wait=2.5")));
        assert!(!job.apply_to(&uri("await=1&q=wait")));
        assert!(!Waits::Never.apply_to(&uri("refine=wait&wait=5")));
    }

    #[test]
    fn a_head_request_has_the_policy_of_get_and_other_methods_have_none() {
        let mut policies = Policies::default();
        policies.declare(Some(Method::GET), "/maps", RoutePolicy::robot());
        policies.declare(Some(Method::PUT), "/maps", RoutePolicy::admin());
        assert_eq!(policies.of(&Method::HEAD, "/maps"), Some(RoutePolicy::robot()));
        assert_eq!(policies.of(&Method::POST, "/maps"), None);
        assert_eq!(policies.of(&Method::GET, "/nonsense"), None);
        assert_eq!(policies.allowed_methods("/maps").as_deref(), Some("GET,HEAD,PUT"));
    }
}
