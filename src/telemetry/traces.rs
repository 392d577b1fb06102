//! Traces for OpenTelemetry, sent over OTLP: a span for each request and its stages, for the job that comes of it
//! in whichever process, and for each call to a model.
//!
//! Spans have a target of their own and are in no log. Without `traces.url` nobody wants them, and they cost
//! next to nothing.

use std::collections::HashMap;
use std::time::Duration;

use axum::http::HeaderMap;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::{TraceContextExt, TracerProvider};
use opentelemetry::{Context, KeyValue};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{Sampler, SdkTracerProvider};
use serde::{Deserialize, Serialize};
use tracing::{Metadata, Span, Subscriber, field};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::Layer;
use tracing_subscriber::registry::LookupSpan;

/// The target of all spans that are sent.
const TARGET: &str = "whereabouts::trace";

const TRACEPARENT: &str = "traceparent";

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
    pub fn contradiction(&self) -> Option<String> {
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

/// What sends traces. Its end sends the last of them.
#[derive(Debug, Default)]
pub struct Traces(Option<SdkTracerProvider>);

impl Traces {
    /// Nothing is sent until [`Traces::layer`] is in use.
    pub fn start(settings: &TraceSettings) -> Result<Self, String> {
        if settings.url.is_empty() {
            return Ok(Self::default());
        }
        let timeout = Duration::from_millis(settings.timeout_ms);
        let exporter = SpanExporter::builder()
            .with_http()
            .with_protocol(Protocol::HttpBinary)
            .with_endpoint(format!("{}/v1/traces", settings.url.trim_end_matches('/')))
            .with_timeout(timeout)
            .build()
            .map_err(|error| format!("traces cannot be sent to traces.url: {error}"))?;
        let process = KeyValue::new("service.instance.id", uuid::Uuid::now_v7().to_string());
        let version = KeyValue::new("service.version", env!("CARGO_PKG_VERSION"));
        let resource = Resource::builder()
            .with_service_name("whereabouts")
            .with_attributes([process, version])
            .build();
        let by_share = Sampler::TraceIdRatioBased(settings.share);
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_sampler(Sampler::ParentBased(Box::new(by_share)))
            .with_resource(resource)
            .build();
        Ok(Self(Some(provider)))
    }

    /// Takes spans from those who make them.
    pub fn layer<S>(&self) -> Option<impl Layer<S> + use<S>>
    where
        S: Subscriber + for<'a> LookupSpan<'a>,
    {
        let tracer = self.0.as_ref()?.tracer("whereabouts");
        let ours = tracing_subscriber::filter::filter_fn(|about| about.is_span() && is_ours(about));
        let layer = tracing_opentelemetry::layer()
            .with_tracer(tracer)
            .with_location(false)
            .with_threads(false)
            .with_target(false);
        Some(layer.with_filter(ours))
    }
}

impl Drop for Traces {
    fn drop(&mut self) {
        if let Some(provider) = self.0.take()
            && let Err(error) = provider.shutdown()
        {
            tracing::warn!(%error, "the last traces were not sent");
        }
    }
}

/// Whether a span is of a trace.
pub(super) fn is_ours(about: &Metadata<'_>) -> bool {
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
        let _ = span.set_parent(TraceContextPropagator::new().extract(&Headers(headers)));
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
    if let Some(traceparent) = traceparent.filter(|_| !span.is_disabled()) {
        let parent = HashMap::from([(TRACEPARENT.to_owned(), traceparent.to_owned())]);
        let _ = span.set_parent(TraceContextPropagator::new().extract(&parent));
    }
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

/// The trace that is going on: its `traceparent` for other processes, and its id; `None` where nothing is traced.
pub fn current() -> Option<(String, String)> {
    let context = Span::current().context();
    let id = {
        let span = context.span();
        let span = span.span_context();
        (span.is_valid() && span.is_sampled()).then(|| span.trace_id().to_string())?
    };
    Some((traceparent(&context)?, id))
}

fn traceparent(context: &Context) -> Option<String> {
    let mut written = HashMap::new();
    TraceContextPropagator::new().inject_context(context, &mut written);
    written.remove(TRACEPARENT)
}

struct Headers<'a>(&'a HeaderMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(axum::http::HeaderName::as_str).collect()
    }
}
