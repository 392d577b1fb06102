//! Completes the OpenAPI description with what many calls have in common: keys, roles, errors, headers.

use axum::http::Method;
use utoipa::openapi::path::{Operation, ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::{ObjectBuilder, Type};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{ContentBuilder, OpenApi, Ref, RefOr, Required, Response, ResponseBuilder};

use super::examples;
use crate::gate::{Access, LONGEST_KEY, Policies};

/// The name of the security scheme.
const KEY: &str = "key";

/// Adds to every call what follows from its policy: who may call it, which headers it takes, how it can fail.
pub(super) fn completed(mut description: OpenApi, policies: &Policies) -> OpenApi {
    let scheme = HttpBuilder::new().scheme(HttpAuthScheme::Bearer).description(Some(
        "An API key, created by `whereabouts keys create`. A server that listens on loopback only requires none \
         unless it is configured to.",
    ));
    let components = description.components.get_or_insert_default();
    components.add_security_scheme(KEY, SecurityScheme::Http(scheme.build()));
    for (route, item) in &mut description.paths.paths {
        let operations = [
            (Method::GET, &mut item.get),
            (Method::PUT, &mut item.put),
            (Method::POST, &mut item.post),
            (Method::PATCH, &mut item.patch),
            (Method::DELETE, &mut item.delete),
        ];
        for (method, operation) in operations {
            if let Some(operation) = operation
                && let Some(policy) = policies.of(&method, route)
                && let Access::Role(role) = policy.access
            {
                complete(operation, role.as_str());
                if policy.idempotent {
                    add_idempotency_key(operation);
                }
            }
        }
    }
    examples::show(&mut description);
    description
}

fn complete(operation: &mut Operation, role: &str) {
    let scopes: [&str; 0] = [];
    operation.security = Some(vec![SecurityRequirement::new(KEY, scopes)]);
    let note = format!("Requires the role `{role}`, where the server requires keys.");
    operation.description = Some(match operation.description.take() {
        Some(text) => format!("{text}\n\n{note}"),
        None => note,
    });
    let malformed = operation.parameters.as_ref().is_some_and(|parameters| !parameters.is_empty());
    let has_body = operation.request_body.is_some();
    if malformed {
        can_fail(operation, [("400", "Malformed")]);
    }
    if has_body {
        can_fail(operation, [("408", "The body arrived too slowly"), ("413", "Too large")]);
    }
    can_fail(
        operation,
        [
            ("401", "No key, or one that is unknown, revoked or expired"),
            ("403", "The key does not have the role, or does not include the map"),
            ("429", "Overloaded, or the rate limit of the key is exhausted"),
            ("500", "A defect, or a failing disk; the server's log says more"),
            ("503", "Starting, or the request timed out; Retry-After says when to try again"),
        ],
    );
}

/// Adds problems by status, except those that the call itself describes.
fn can_fail<const N: usize>(operation: &mut Operation, problems: [(&str, &str); N]) {
    for (status, text) in problems {
        let responses = &mut operation.responses.responses;
        responses.entry(status.into()).or_insert_with(|| problem(text));
    }
}

/// Adds the header `Idempotency-Key`.
fn add_idempotency_key(operation: &mut Operation) {
    let key = ObjectBuilder::new()
        .schema_type(Type::String)
        .min_length(Some(1))
        .max_length(Some(LONGEST_KEY))
        .pattern(Some("^[!-~]+$"));
    let header = ParameterBuilder::new()
        .name("Idempotency-Key")
        .parameter_in(ParameterIn::Header)
        .required(Required::False)
        .schema(Some(key))
        .description(Some(
            "A text of the sender's choice, unique to the request. The same request with the same key is not \
             executed again: it gets the stored answer (with Idempotent-Replayed: true), 409 while the first \
             is in progress, and 422 if the key was used for another request. Errors are not stored.",
        ));
    operation.parameters.get_or_insert_default().push(header.build().into());
    can_fail(
        operation,
        [
            ("400", "Malformed"),
            ("409", "A request with this Idempotency-Key is in progress"),
            ("422", "The Idempotency-Key was used for another request"),
        ],
    );
}

fn problem(text: &str) -> RefOr<Response> {
    let schema = Ref::from_schema_name("Problem");
    let content = ContentBuilder::new().schema(Some(schema)).build();
    let response = ResponseBuilder::new().description(text);
    response.content("application/problem+json", content).build().into()
}
