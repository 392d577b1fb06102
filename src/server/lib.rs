//! The server: everything behind the listener, and the wiring of all parts.
//!
//! | module | what it is for |
//! |---|---|
//! | `gate` | what every request passes, whatever its protocol: connections, bounds, keys, errors |
//! | [`http`] | the routes of HTTP |
//! | `grpc` | the calls of the contract in `proto/` |
//! | `console` | the operator's page |
//! | `router` | puts the routes of all protocols behind the gate |
//! | [`config`] | settings: defaults, file, environment, flags |
//! | [`startup`] | builds the parts, serves, drains |
//!
//! `http`, `grpc` and `console` depend on `gate`, and not on one another.

pub mod config;
#[cfg(feature = "console")]
mod console;
mod gate;
#[cfg(feature = "grpc")]
mod grpc;
pub mod http;
mod levels;
mod metrics;
mod router;
pub mod startup;
mod sync;

pub use levels::Levels;
pub use metrics::Metrics;
