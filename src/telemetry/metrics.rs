//! The metrics registry and helpers shared by all metric families. Each member defines and registers its own families.

use std::fmt;

use prometheus_client::encoding::text;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{self, Metric};

/// All metrics of a process.
#[derive(Debug)]
pub struct Registry {
    metrics: registry::Registry,
    families: Vec<FamilyInfo>,
}

/// What is known of a family before it has a sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FamilyInfo {
    /// Name without the prefix of all metrics and without the suffix of counters.
    pub name: String,
    /// Type in the OpenMetrics format.
    pub kind: String,
    /// Help text.
    pub help: String,
}

impl Registry {
    /// The families in the order of their registration, also those that have no samples and are not encoded.
    pub fn families(&self) -> &[FamilyInfo] {
        &self.families
    }
}

/// Creates an empty registry. All metric names are prefixed with `whereabouts_`.
pub fn registry() -> Registry {
    Registry { metrics: registry::Registry::with_prefix("whereabouts"), families: Vec::new() }
}

/// Registers a metric under its name, with its help text, and returns it.
pub fn register<M: Metric + Clone>(
    registry: &mut Registry,
    name: &str,
    help: &str,
    metric: M,
) -> M {
    let kind = metric.metric_type().as_str().to_owned();
    registry.families.push(FamilyInfo { name: name.to_owned(), kind, help: help.to_owned() });
    registry.metrics.register(name, help, metric.clone());
    metric
}

/// Creates a latency histogram in seconds, with 16 exponential buckets from 0.5 ms to about 16 s.
pub fn latency() -> Histogram {
    Histogram::new(exponential_buckets(0.0005, 2.0, 16))
}

/// Encodes all metrics of a registry in the OpenMetrics text format.
pub fn encode(registry: &Registry) -> Result<String, fmt::Error> {
    let mut out = String::new();
    text::encode(&mut out, &registry.metrics)?;
    Ok(out)
}
