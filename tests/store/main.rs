//! The contract of the store: what its traits promise, held against both stores.
//!
//! Each promise is one function, which runs once with the embedded store and once with PostgreSQL; those about
//! picture bytes also with a server that speaks S3. `processes` and `outages` are about PostgreSQL alone: what
//! several processes promise each other, and what happens when the database or the object store is away.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[macro_use]
mod support;

mod answers;
mod blobs;
mod descriptions;
mod drafts;
mod images;
mod jobs;
mod keys;
mod maps;
mod outages;
mod processes;
mod retention;
mod search;
mod usage;
mod webhooks;
