//! The contract of the store: what its traits promise, tested against both stores.
//!
//! Each promise is one function, which runs once with the embedded store and once with PostgreSQL; those about
//! picture bytes also with an S3-compatible server. `processes`, `limits`, `schema`, `twins` and `outages` are about
//! PostgreSQL only: what several processes can rely on, and what happens when the database or the object store is
//! unavailable.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[macro_use]
mod support;
mod twins;

mod answers;
mod blobs;
mod corrections;
mod crowds;
mod descriptions;
mod drafts;
mod images;
mod job_lists;
mod jobs;
mod keys;
mod limits;
mod maps;
mod outages;
mod processes;
mod retention;
mod schema;
mod search;
mod texts;
mod tracks;
mod usage;
mod webhooks;
