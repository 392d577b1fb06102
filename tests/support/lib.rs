//! What tests and benchmarks share: the real server as a child process ([`server`]), the store that it uses
//! ([`deployment`]), waiting for a condition ([`wait`]), drives and the baselines of tracks ([`drives`]), test
//! patterns ([`patterns`]), and scripted peers: a multimodal LLM ([`mock_mllm`]), an overloaded host in front of it ([`front`]), a model hub ([`mock_hub`])
//! and a webhook receiver ([`receiver`]).

#![allow(
    missing_docs,
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "only tests call it; a panic is a failed test"
)]

pub mod deployment;
pub mod drives;
pub mod front;
pub mod mock_hub;
pub mod mock_mllm;
pub mod patterns;
pub mod receiver;
pub mod server;
pub mod wait;
