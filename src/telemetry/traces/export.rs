//! Export of spans over OTLP, and propagation of trace contexts between processes (W3C Trace Context).

use std::collections::HashMap;
use std::time::Duration;

use opentelemetry::propagation::TextMapPropagator;
use opentelemetry::trace::{TraceContextExt, TracerProvider};
use opentelemetry::{Context, KeyValue};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{Sampler, SdkTracerProvider};
use tracing::{Span, Subscriber};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::Layer;
use tracing_subscriber::registry::LookupSpan;

use super::{TRACEPARENT, TRACESTATE, TraceSettings, is_trace_span};

/// The trace exporter. Dropping it flushes the remaining spans.
#[derive(Debug, Default)]
pub struct Traces(Option<SdkTracerProvider>);

impl Traces {
    /// Starts the exporter. Spans reach it through [`Traces::layer`].
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
        let by_rate = Sampler::TraceIdRatioBased(settings.share);
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_sampler(Sampler::ParentBased(Box::new(by_rate)))
            .with_resource(resource)
            .build();
        Ok(Self(Some(provider)))
    }

    /// Creates the layer that collects spans; `None` if tracing is disabled.
    pub fn layer<S>(&self) -> Option<impl Layer<S> + use<S>>
    where
        S: Subscriber + for<'a> LookupSpan<'a>,
    {
        let tracer = self.0.as_ref()?.tracer("whereabouts");
        let trace_spans =
            tracing_subscriber::filter::filter_fn(|span| span.is_span() && is_trace_span(span));
        let layer = tracing_opentelemetry::layer()
            .with_tracer(tracer)
            .with_location(false)
            .with_threads(false)
            .with_target(false);
        Some(layer.with_filter(trace_spans))
    }
}

impl Drop for Traces {
    fn drop(&mut self) {
        if let Some(provider) = self.0.take()
            && let Err(error) = provider.shutdown()
        {
            tracing::warn!(%error, "cannot flush the remaining traces");
        }
    }
}

/// Makes a span a child of the given trace context.
pub(super) fn set_parent(span: &Span, traceparent: Option<&str>, tracestate: Option<&str>) {
    if span.is_disabled() {
        return;
    }
    let headers = [(TRACEPARENT, traceparent), (TRACESTATE, tracestate)];
    let carrier: HashMap<String, String> = headers
        .into_iter()
        .filter_map(|(name, value)| Some((name.to_owned(), value?.to_owned())))
        .collect();
    if !carrier.is_empty() {
        let _ = span.set_parent(TraceContextPropagator::new().extract(&carrier));
    }
}

/// The `traceparent` and the trace id of the current span; `None` if it is not traced.
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
    let mut carrier = HashMap::new();
    TraceContextPropagator::new().inject_context(context, &mut carrier);
    carrier.remove(TRACEPARENT)
}
