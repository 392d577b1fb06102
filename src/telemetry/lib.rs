//! Logs, traces, the metrics registry, and a summary for operators: statistics of the last hour and recent log issues.
//! This member does not depend on the types of other members.

pub mod metrics;
mod recent;
pub mod traces;

use std::io::IsTerminal;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tracing_subscriber::filter::{FilterExt, LevelFilter, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, fmt};

use self::recent::IssueCollector;
pub use self::recent::{HourlyStats, LogIssue, LogIssues, Minute};
pub use self::traces::{TraceSettings, Traces};

/// `[log]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogSettings {
    /// Format of log lines.
    pub format: LogFormat,
    /// Filter directives, as of `tracing_subscriber::EnvFilter`.
    pub filter: String,
}

/// The format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Pretty on a terminal, JSON otherwise.
    Auto,
    /// Human-readable lines.
    Pretty,
    /// One JSON object per line.
    Json,
}

/// Starts logging to standard error and exporting traces. Returns the recent log issues and the trace exporter. Only the
/// first call installs the subscriber.
pub fn init(log: &LogSettings, traces: &TraceSettings) -> Result<(Arc<LogIssues>, Traces), String> {
    let filter = EnvFilter::try_new(&log.filter)
        .map_err(|error| format!("log.filter cannot be read: {error}"))?;
    let pretty = match log.format {
        LogFormat::Pretty => true,
        LogFormat::Json => false,
        LogFormat::Auto => std::io::stderr().is_terminal(),
    };
    let lines = fmt::layer().with_writer(std::io::stderr);
    let lines = match pretty {
        true => lines.with_target(false).boxed(),
        false => lines.json().flatten_event(true).boxed(),
    };
    let issues = Arc::new(LogIssues::default());
    let collector = IssueCollector(Arc::clone(&issues)).with_filter(LevelFilter::WARN);
    let traces = Traces::start(traces)?;
    let no_trace_spans = filter_fn(|span| !(span.is_span() && traces::is_trace_span(span)));
    let _ = tracing_subscriber::registry()
        .with(traces.layer())
        .with(lines.with_filter(filter.and(no_trace_spans)))
        .with(collector)
        .try_init();
    Ok((issues, traces))
}
