//! Rate limits of a key, in request bodies and response headers.

use std::fmt::Write as _;
use std::sync::Arc;

use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use futures_util::TryStreamExt;
use whereabouts_core::ApiKey;
use whereabouts_service::{Allowances, Service};

const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");
const RATE_LIMIT_POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");

/// Charges the bytes of a body to the key as they arrive.
pub(super) fn charge_body(request: Request, service: &Arc<Service>, key: &Arc<ApiKey>) -> Request {
    if key.limits.bytes_per_minute.is_none() {
        return request;
    }
    let (service, key) = (Arc::clone(service), Arc::clone(key));
    request.map(|body| {
        let charge = move |chunk: bytes::Bytes| {
            let (service, key) = (Arc::clone(&service), Arc::clone(&key));
            async move {
                service.keys.limits.take_bytes(&key, chunk.len()).await;
                Ok(chunk)
            }
        };
        Body::from_stream(body.into_data_stream().and_then(charge))
    })
}

/// Writes what is left of the key's rate limits into the headers of
/// draft-ietf-httpapi-ratelimit-headers-10 (*RateLimit header fields for HTTP*).
pub(super) fn write_headers(allowances: &Allowances, headers: &mut HeaderMap) {
    let (mut policy, mut remaining) = (String::new(), String::new());
    for (name, unit, allowance) in [
        ("requests", "", allowances.requests),
        ("bytes", ";qu=\"content-bytes\"", allowances.bytes),
    ] {
        let Some(allowance) = allowance else { continue };
        let comma = if policy.is_empty() { "" } else { ", " };
        // Writing to a string does not fail.
        let _ = write!(policy, "{comma}\"{name}\";q={}{unit};w=60", allowance.limit);
        let seconds = allowance.reset.as_secs_f64().ceil();
        let _ = write!(remaining, "{comma}\"{name}\";r={};t={seconds}", allowance.remaining);
    }
    if policy.is_empty() {
        return;
    }
    for (name, text) in [(RATE_LIMIT_POLICY, policy), (RATE_LIMIT, remaining)] {
        if let Ok(value) = HeaderValue::from_str(&text) {
            headers.insert(name, value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remaining_allowances_are_written_in_the_standard_headers() {
        let requests = whereabouts_service::Allowance {
            limit: 600,
            remaining: 12,
            reset: std::time::Duration::from_millis(58_800),
        };
        let bytes = whereabouts_service::Allowance { limit: 1_000_000, remaining: 0, ..requests };
        let mut headers = HeaderMap::new();
        let both = Allowances { requests: Some(requests), bytes: Some(bytes) };
        write_headers(&both, &mut headers);
        assert_eq!(
            headers["ratelimit-policy"],
            "\"requests\";q=600;w=60, \"bytes\";q=1000000;qu=\"content-bytes\";w=60"
        );
        assert_eq!(headers["ratelimit"], "\"requests\";r=12;t=59, \"bytes\";r=0;t=59");
        let mut none = HeaderMap::new();
        write_headers(&Allowances::default(), &mut none);
        assert!(none.is_empty());
    }
}
