//! The metrics registry and helpers shared by all metric families. Each member defines and registers its own families.

use std::fmt;

use prometheus_client::encoding::text;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::Metric;
pub use prometheus_client::registry::Registry;

/// Creates an empty registry. All metric names are prefixed with `whereabouts_`.
pub fn registry() -> Registry {
    Registry::with_prefix("whereabouts")
}

/// Registers a metric under its name, with its help text, and returns it.
pub fn register<M: Metric + Clone>(
    registry: &mut Registry,
    name: &str,
    help: &str,
    metric: M,
) -> M {
    registry.register(name, help, metric.clone());
    metric
}

/// Creates a latency histogram in seconds, with 16 exponential buckets from 0.5 ms to about 16 s.
pub fn latency() -> Histogram {
    Histogram::new(exponential_buckets(0.0005, 2.0, 16))
}

/// Encodes all metrics of a registry in the OpenMetrics text format.
pub fn encode(registry: &Registry) -> Result<String, fmt::Error> {
    let mut out = String::new();
    text::encode(&mut out, registry)?;
    Ok(out)
}
