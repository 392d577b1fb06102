//! OpenTelemetry traces: spans of requests and their stages, of refinement jobs (which may run in another process), and
//! of calls to a model.
//!
//! These spans have a separate target and do not appear in logs. Without `traces.url` they are disabled and cost almost
//! nothing. Exporting them over OTLP needs the Cargo feature `otel`.

#[cfg(feature = "otel")]
mod export;
#[cfg(not(feature = "otel"))]
#[path = "traces/no_export.rs"]
mod export;

use http::HeaderMap;
use serde::{Deserialize, Serialize};
use tracing::{Metadata, Span, field};

pub use self::export::{Traces, current};

/// Target of all exported spans.
const TARGET: &str = "whereabouts::trace";

const TRACEPARENT: &str = "traceparent";
const TRACESTATE: &str = "tracestate";

/// `[traces]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TraceSettings {
    /// URL of a collector that accepts OTLP over HTTP; empty to disable tracing.
    pub url: String,
    /// Sampling rate of requests, 0 to 1, unless the caller decides by a trace context.
    pub share: f64,
    /// Timeout of an export in milliseconds.
    pub timeout_ms: u64,
}

impl TraceSettings {
    /// Returns why the settings are invalid, or `None` if they are valid.
    pub fn validate(&self) -> Option<String> {
        if !(0.0..=1.0).contains(&self.share) {
            return Some("traces.share must be from 0 to 1".into());
        }
        let is_url = self.url.starts_with("http://") || self.url.starts_with("https://");
        if !self.url.is_empty() && !is_url {
            return Some("traces.url must begin with http:// or https://".into());
        }
        (self.timeout_ms == 0).then(|| "traces.timeout_ms must be at least 1".into())
    }
}

/// Whether a span is exported with traces.
pub(crate) fn is_trace_span(span: &Metadata<'_>) -> bool {
    span.target() == TARGET
}

/// Creates the span of a request. It continues the trace named by the headers, if any (W3C Trace Context).
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

/// Records the response status of a request.
pub fn answered(span: &Span, status: u16) {
    span.record("http.response.status_code", status);
    if status >= 500 {
        span.record("otel.status_code", "ERROR");
    }
}

/// Creates the span of a stage of a request.
pub fn stage(name: &'static str) -> Span {
    tracing::info_span!(target: TARGET, "stage", otel.name = name)
}

/// Creates the span of one attempt at a job. It continues the trace of the request that submitted the job.
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

/// Creates the span of a call to a model, following the OpenTelemetry semantic conventions for generative AI.
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

/// Records the token usage or the error of a call to a model.
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
