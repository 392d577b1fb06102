//! Traces for OpenTelemetry: a span for each request and its stages, for the refinement job in whichever process,
//! and for each call to a model.
//!
//! These spans have a target of their own and appear in no log. Without `traces.url` they are disabled and cost
//! next to nothing. Sending them over OTLP needs the Cargo feature `otel`.

#[cfg(feature = "otel")]
mod export;
#[cfg(not(feature = "otel"))]
#[path = "traces/no_export.rs"]
mod export;

use http::HeaderMap;
use serde::{Deserialize, Serialize};
use tracing::{Metadata, Span, field};

pub use self::export::{Traces, current};

/// The target of all spans that are sent.
const TARGET: &str = "whereabouts::trace";

const TRACEPARENT: &str = "traceparent";
const TRACESTATE: &str = "tracestate";

/// `[traces]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TraceSettings {
    /// A collector that takes OTLP over HTTP; empty for none.
    pub url: String,
    /// The share of requests that are traced, 0 to 1, where the caller does not say.
    pub share: f64,
    /// The longest that sending may take, in milliseconds.
    pub timeout_ms: u64,
}

impl TraceSettings {
    /// Why these settings cannot be used, if so.
    pub fn validate(&self) -> Option<String> {
        if !(0.0..=1.0).contains(&self.share) {
            return Some("traces.share must be from 0 to 1".into());
        }
        let is_address = self.url.starts_with("http://") || self.url.starts_with("https://");
        if !self.url.is_empty() && !is_address {
            return Some("traces.url must begin with http:// or https://".into());
        }
        (self.timeout_ms == 0).then(|| "traces.timeout_ms must be at least 1".into())
    }
}

/// Whether a span is of a trace.
pub(crate) fn is_ours(about: &Metadata<'_>) -> bool {
    about.target() == TARGET
}

/// The span of a request; it belongs to the trace that its headers name, if they do
/// (W3C Trace Context).
pub fn request(method: &str, route: &str, headers: &HeaderMap) -> Span {
    let span = tracing::info_span!(
        target: TARGET,
        "request",
        otel.name = format!("{method} {route}"),
        otel.kind = "server",
        http.request.method = method,
        http.route = route,
        http.response.status_code = field::Empty,
        otel.status_code = field::Empty,
    );
    if !span.is_disabled() {
        export::set_parent(
            &span,
            headers.get(TRACEPARENT).and_then(|value| value.to_str().ok()),
            headers.get(TRACESTATE).and_then(|value| value.to_str().ok()),
        );
    }
    span
}

/// Notes what a request was answered with.
pub fn answered(span: &Span, status: u16) {
    span.record("http.response.status_code", status);
    if status >= 500 {
        span.record("otel.status_code", "ERROR");
    }
}

/// The span of a stage of a request.
pub fn stage(name: &'static str) -> Span {
    tracing::info_span!(target: TARGET, "stage", otel.name = name)
}

/// The span of one attempt at a job, which belongs to the trace of its request.
pub fn job(id: uuid::Uuid, refiner: &str, attempt: u32, traceparent: Option<&str>) -> Span {
    let span = tracing::info_span!(
        target: TARGET,
        "job",
        otel.name = format!("job {refiner}"),
        otel.kind = "consumer",
        job.id = %id,
        job.attempt = attempt,
    );
    export::set_parent(&span, traceparent, None);
    span
}

/// The span of one call to a model, in the words of OpenTelemetry's conventions for generative AI.
pub fn model_call(model: &str, what: &'static str) -> Span {
    tracing::info_span!(
        target: TARGET,
        "model_call",
        otel.name = format!("chat {model}"),
        otel.kind = "client",
        gen_ai.operation.name = "chat",
        gen_ai.request.model = model,
        gen_ai.usage.input_tokens = field::Empty,
        gen_ai.usage.output_tokens = field::Empty,
        whereabouts.call = what,
        otel.status_code = field::Empty,
        otel.status_description = field::Empty,
    )
}

/// Notes how a call to a model ended.
pub fn model_answered(span: &Span, tokens: Result<(u64, u64), String>) {
    match tokens {
        Ok((input, output)) => {
            span.record("gen_ai.usage.input_tokens", input);
            span.record("gen_ai.usage.output_tokens", output);
        }
        Err(error) => {
            span.record("otel.status_code", "ERROR");
            span.record("otel.status_description", error);
        }
    }
}
