//! Metrics of requests and connections, and the registry of all metric families.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use whereabouts_refine::RefineMetrics;
use whereabouts_service::{Rejection, Rejections, ServiceMetrics};
use whereabouts_telemetry::HourlyStats;
use whereabouts_telemetry::metrics::{self, Registry, latency, register};

use super::levels::{Gauges, Levels};

/// All metrics of a process: those of the server itself, and those that other members registered.
#[derive(Debug)]
pub struct Metrics {
    /// Statistics of the last hour.
    pub last_hour: Arc<HourlyStats>,
    /// Of refinement.
    pub refine: Arc<RefineMetrics>,
    /// Of the use cases.
    pub service: Arc<ServiceMetrics>,
    registry: Registry,
    levels: Gauges,
    requests: Family<RequestLabels, Counter>,
    request_seconds: Family<RouteLabels, Histogram, fn() -> Histogram>,
    connections: Gauge,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RequestLabels {
    method: String,
    route: String,
    status: u16,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RouteLabels {
    route: String,
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

impl Metrics {
    /// Registers all families; all counts are zero.
    pub fn new() -> Self {
        let mut all = metrics::registry();
        let registry = &mut all;
        let last_hour = Arc::new(HourlyStats::default());
        let rejections = Arc::new(Rejections::register(registry));
        Self {
            requests: register(registry, "http_requests", "Requests answered", Family::default()),
            request_seconds: register(
                registry,
                "http_request_seconds",
                "Time from the head of the request to the head of the response",
                Family::new_with_constructor(latency),
            ),
            connections: register(registry, "connections", "Open connections", Gauge::default()),
            service: Arc::new(ServiceMetrics::register(registry, rejections)),
            refine: Arc::new(RefineMetrics::register(registry, Arc::clone(&last_hour))),
            last_hour,
            levels: Gauges::new(registry),
            registry: all,
        }
    }

    /// Counts an answered request; `localizes` says whether its answer is a localized frame.
    pub fn request(&self, method: &str, route: &str, status: u16, took: Duration, localizes: bool) {
        let is_frame = status == 200 && localizes;
        self.last_hour.answered(Timestamp::now(), status, is_frame.then_some(took));
        let route = route.to_owned();
        self.request_seconds
            .get_or_create(&RouteLabels { route: route.clone() })
            .observe(took.as_secs_f64());
        self.requests.get_or_create(&RequestLabels { method: method.into(), route, status }).inc();
    }

    /// Counts a frame of a stream of gRPC that was localized.
    pub fn frame_of_stream(&self, took: Duration) {
        self.last_hour.answered(Timestamp::now(), 200, Some(took));
    }

    /// Counts a rejection.
    pub fn refused(&self, reason: Rejection) {
        self.service.refusals.count(reason);
    }

    /// Counts a connection that was opened.
    pub fn connection_opened(&self) {
        self.connections.inc();
    }

    /// Counts a connection that was closed.
    pub fn connection_closed(&self) {
        self.connections.dec();
    }

    /// Sets the gauges that are read at a scrape.
    pub fn set_levels(&self, levels: &Levels) {
        self.levels.set(levels);
    }

    /// All metrics in the OpenMetrics text format.
    pub fn encode(&self) -> Result<String, fmt::Error> {
        metrics::encode(&self.registry)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_family_has_its_name_type_and_help() {
        let metrics = Metrics::new();
        let families = metrics.registry.families().iter();
        let lines: Vec<String> = families
            .map(|family| format!("{} {}: {}", family.name, family.kind, family.help))
            .collect();
        insta::assert_snapshot!("families", lines.join("\n"));
    }
}
