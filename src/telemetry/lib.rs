//! Logs, traces, the metrics registry, and what an operator looks at first: the last hour and the last warnings.
//! Knows no types of the other members.

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

use self::recent::Listener;
pub use self::recent::{HourlyStats, LogIssue, LogIssues, Minute};
pub use self::traces::{TraceSettings, Traces};

/// `[log]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogSettings {
    /// How lines look.
    pub format: LogFormat,
    /// What is logged.
    pub filter: String,
}

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Pretty on a terminal, JSON elsewhere.
    Auto,
    /// For people.
    Pretty,
    /// One JSON object a line.
    Json,
}

/// Starts logging to standard error and tracing, and gives the last warnings and errors, and what sends the
/// traces. A second call changes nothing.
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
    let troubles = Arc::new(LogIssues::default());
    let listener = Listener(Arc::clone(&troubles)).with_filter(LevelFilter::WARN);
    let traces = Traces::start(traces)?;
    let no_span_of_a_trace = filter_fn(|about| !(about.is_span() && traces::is_ours(about)));
    let _ = tracing_subscriber::registry()
        .with(traces.layer())
        .with(lines.with_filter(filter.and(no_span_of_a_trace)))
        .with(listener)
        .try_init();
    Ok((troubles, traces))
}
