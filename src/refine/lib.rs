//! The vision-language refiner: compares a frame with each of its candidates, describes in words what
//! agrees and what differs, and ranks the candidates again.
//!
//! A [`Refiner`] does this for one [`RefineInput`]; [`REFINERS`] is the table of all refiners. The
//! [`Worker`] claims jobs from the queue and has them refined. [`local`] compares dense features on this
//! machine, [`mllm`] asks a multimodal LLM, [`cascade`] does the second only where the first does not suffice.

mod attempts;
pub mod cascade;
mod choice;
mod dense_cache;
mod frame_reader;
mod input;
mod job_settings;
pub mod local;
mod metrics;
pub mod mllm;
mod refiner;
mod registry;
mod store_retry;
mod sync;
mod worker;

use std::sync::Arc;

use parking_lot::Mutex;
use whereabouts_core::ServiceTime;

pub use attempts::{AttemptPolicy, NextAttempt};
pub use choice::RefinerSet;
pub use dense_cache::{DenseCache, DenseKey};
pub use frame_reader::{FrameReader, FrameTexts};
pub use input::{QueryFrame, RefineInput};
pub use job_settings::JobSettings;
pub use local::LocalRefiner;
pub use metrics::{CacheLookup, RefineMetrics};
pub use refiner::{
    NegativeEvidence, PaidCallLevels, PaidCalls, PaidMeasurement, PaidNegatives, Progress,
    RefineError, Refinement, Refiner, RegionMatcher,
};
pub use registry::{BuildError, REFINERS, RefinerContext, RefinerEntry, RefinerSettings};
pub use store_retry::retry_for;
pub use worker::Worker;

pub(crate) use refiner::{Unwatched, milliseconds};

/// Moving average of the time that jobs take.
pub type JobServiceTime = Arc<Mutex<ServiceTime>>;
