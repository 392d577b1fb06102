//! `whereabouts` tells a robot where it is from one camera frame.
//!
//! | module | what it is for |
//! |---|---|
//! | [`domain`] | the words: map, image, pose, descriptor, candidate, job; no I/O |
//! | [`retrieve`] | the coarse retriever: decode, preprocess, inference, pooling, index |
//! | [`refine`] | the vision-language refiner: compare, describe, rank; the worker |
//! | [`models`] | installing models: catalogue, download, the folder of those installed |
//! | [`store`] | what must outlive the process |
//! | [`service`] | the use cases: the one meaning behind HTTP and the command line |
//! | [`evaluate`] | how often the service is right on two folders: layouts, recall, reports |
//! | [`archive`] | the file of `whereabouts backup`: written, continued, read with suspicion |
//! | [`http`] | axum: extract, call the service, convert |
//! | [`grpc`] | tonic: the same for the contract in `proto/` |
//! | [`console`] | the operator's page and what it is made of |
//! | [`cli`] | one file for each command |
//! | [`demo`] | a procedural town, to try it all on |
//! | [`config`], [`telemetry`], [`startup`] | settings, logs and metrics, wiring |
//!
//! Dependencies point one way: `cli, http, grpc, evaluate → service → retrieve, refine, store → domain`. Only
//! [`startup`] sees everything.

pub mod archive;
pub mod cli;
pub mod config;
pub mod console;
pub mod demo;
pub mod domain;
pub mod evaluate;
pub mod grpc;
pub mod http;
pub mod models;
pub mod refine;
pub mod retrieve;
pub mod service;
pub mod startup;
pub mod store;
pub mod telemetry;
