//! Acknowledged changes survive: the real server is killed at random moments, and its files and its disk are
//! damaged.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod clients;
mod disk;
mod faults;
mod kill;
mod ledger;
mod needs_mount;

use whereabouts_testkit::{server as support, wait};
