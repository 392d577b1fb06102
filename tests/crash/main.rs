//! What was acknowledged survives: the real server is killed at random moments, and its files and its
//! disk are tampered with.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod clients;
#[path = "../blackbox/deployment.rs"]
#[allow(dead_code)]
mod deployment;
mod disk;
mod faults;
mod kill;
mod ledger;
#[path = "../blackbox/support.rs"]
#[allow(dead_code)]
mod support;
