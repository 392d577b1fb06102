//! Logs, metrics and traces.

mod levels;
mod metrics;
mod recent;
mod refused;
pub mod traces;

use std::io::IsTerminal;
use std::sync::Arc;

use tracing_subscriber::filter::{FilterExt, LevelFilter, filter_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, fmt};

pub use self::levels::Levels;
pub use self::metrics::{AttemptOutcome, CacheLookup, Metrics};
use self::recent::Listener;
pub use self::recent::{LastHour, Minute, Trouble, Troubles};
pub use self::refused::RefusedFor;
pub use self::traces::{TraceSettings, Traces};
use crate::config::{Log, LogFormat};

/// Starts logging to standard error and tracing, and gives the last warnings and errors, and what sends the
/// traces. A second call changes nothing.
pub fn init(log: &Log, traces: &TraceSettings) -> Result<(Arc<Troubles>, Traces), String> {
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
    let troubles = Arc::new(Troubles::default());
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
