//! The server: what stands behind the listener, and the wiring of everything.
//!
//! | module | what it is for |
//! |---|---|
//! | [`http`] | axum: extract, call the service, convert |
//! | [`grpc`] | tonic: the same for the contract in `proto/` |
//! | [`console`] | the operator's page |
//! | [`config`] | settings: defaults, file, environment, flags |
//! | [`startup`] | builds the parts, serves, drains |

pub mod config;
pub mod console;
pub mod grpc;
pub mod http;
mod levels;
mod metrics;
pub mod startup;

pub use levels::Levels;
pub use metrics::Metrics;
