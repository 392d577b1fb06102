//! Black-box tests: they start the real binary and talk to it as its users do.
//!
//! Pictures come from the procedural town. Tests that need an input which not every machine has
//! are ignored, in modules `needs_INPUT`; `tests/optional.sh` runs them where the input is.

#![allow(
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "clippy lets tests do this, but not what tests call"
)]

mod archives;
mod backup;
mod bad_input;
mod batch;
mod blank_frames;
mod cli;
mod confidence;
mod console;
mod content;
mod durability;
mod embedded_only;
mod events;
mod formats;
mod http2;
mod idempotency;
mod images;
mod jobs;
mod keys;
mod localize;
mod maps;
mod mllm;
mod odd_folders;
mod off_map;
mod refiner_choice;
mod reindex;
mod retention;
mod scale_out;
mod service;
mod slow_clients;
mod smuggling;
mod tls;
mod traces;
mod track;
mod track_clocks;
mod vocabulary;
mod webhooks;
mod words;

use whereabouts_testkit::{
    deployment, drives, mock_hub, mock_mllm, receiver, server as support, wait,
};
