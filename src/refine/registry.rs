//! The table of refiners, which configuration, command-line help, startup and evaluation read.
//!
//! To add a refiner: its folder, its row in [`REFINERS`], its settings in [`RefinerSettings`], and its name
//! in the contract ([`RefinerKind`], the protocol buffers and the API).

use std::fmt;
use std::sync::Arc;

use futures_util::future::BoxFuture;
use tokio::sync::OnceCell;
use whereabouts_core::{CalibrationSettings, RefinerKind};
use whereabouts_store::{SharedLimits, Store, StoreError};
use whereabouts_vision::{CpuPool, LoadedModels};

use super::cascade::CascadeSettings;
use super::mllm::{MllmRefiner, MllmSettings, MllmSettingsError};
use super::{DenseCache, RefineMetrics, Refiner, cascade, local, mllm};

/// All refiners.
pub const REFINERS: &[RefinerEntry] = &[
    RefinerEntry {
        kind: RefinerKind::Local,
        summary: "Geometric matching of dense features",
        candidates: |settings| settings.local_candidates,
        validate: |_| None,
        fingerprint: local::fingerprint,
        build: |context| Box::pin(local::build(context)),
    },
    RefinerEntry {
        kind: RefinerKind::Cascade,
        summary: "`local`, then `mllm` where its answer is in question",
        candidates: |settings| settings.local_candidates,
        validate: |settings| {
            let cascade = settings.cascade.validate();
            cascade.or_else(|| settings.mllm.validate(settings.job_timeout_s))
        },
        fingerprint: cascade::fingerprint,
        build: |context| Box::pin(cascade::build(context)),
    },
    RefinerEntry {
        kind: RefinerKind::Mllm,
        summary: "A multimodal LLM, configured in `[mllm]`",
        candidates: |settings| settings.mllm_candidates,
        validate: |settings| settings.mllm.validate(settings.job_timeout_s),
        fingerprint: mllm::fingerprint,
        build: |context| Box::pin(mllm::build(context)),
    },
];

/// A row of the table: one refiner, its description, and how it is built.
pub struct RefinerEntry {
    /// The refiner's name in the contract.
    pub kind: RefinerKind,
    /// One line of help.
    pub summary: &'static str,
    /// Returns how many candidates the refiner compares.
    pub candidates: fn(&RefinerSettings) -> usize,
    /// Returns what is wrong with the refiner's settings, if anything is.
    pub validate: fn(&RefinerSettings) -> Option<String>,
    /// Returns a text that changes with everything that decides what the refiner finds. Evaluation keys
    /// its cache of outcomes by it.
    pub fingerprint: fn(&RefinerSettings) -> Result<String, BuildError>,
    /// Builds the refiner.
    pub build: BuildRefiner,
}

/// Builds a refiner from the parts of a process.
pub type BuildRefiner = for<'a> fn(&'a RefinerContext) -> BoxFuture<'a, BuiltRefiner>;

/// A refiner, or why it could not be built.
pub type BuiltRefiner = Result<Arc<dyn Refiner>, BuildError>;

/// The settings of all refiners.
#[derive(Debug, Clone)]
pub struct RefinerSettings {
    /// Candidates that `local` compares.
    pub local_candidates: usize,
    /// Candidates that `mllm` compares.
    pub mllm_candidates: usize,
    /// The settings of `cascade`.
    pub cascade: CascadeSettings,
    /// The settings of `mllm`.
    pub mllm: MllmSettings,
    /// The confidence from which a place counts as known.
    pub known_confidence: f64,
    /// Which images count as the same place; the other settings of calibration are not used.
    pub places: CalibrationSettings,
    /// The longest a job may take, in seconds. A refiner's own timeouts must be shorter.
    pub job_timeout_s: u64,
}

/// The parts of a process that refiners are built from.
#[derive(Clone)]
pub struct RefinerContext {
    /// Maps, pictures, cached descriptions and accounts.
    pub store: Arc<dyn Store>,
    /// Limits that several processes share, if there are several.
    pub shared: Option<Arc<dyn SharedLimits>>,
    /// The models that extract dense features.
    pub models: LoadedModels,
    /// Dense features of recent pictures.
    pub dense: Arc<DenseCache>,
    /// The threads that compare pictures.
    pub pool: CpuPool,
    /// Counts jobs and lookups.
    pub metrics: Arc<RefineMetrics>,
    /// The settings of all refiners.
    pub settings: RefinerSettings,
    /// The one refiner that asks the model, once it is built.
    pub model: Arc<OnceCell<Arc<MllmRefiner>>>,
}

/// Why a refiner could not be built.
#[derive(Debug, thiserror::Error)]
pub enum BuildError {
    /// The settings of `mllm` cannot be used.
    #[error(transparent)]
    Mllm(#[from] MllmSettingsError),
    /// The store could not be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The settings cannot be written as text.
    #[error("the settings cannot be written as JSON: {0}")]
    Fingerprint(#[from] serde_json::Error),
}

impl RefinerEntry {
    /// Returns the refiner's name in configuration and flags.
    pub fn name(&self) -> &'static str {
        self.kind.as_str()
    }
}

impl PartialEq for RefinerEntry {
    fn eq(&self, other: &Self) -> bool {
        self.kind == other.kind
    }
}

impl Eq for RefinerEntry {}

impl fmt::Debug for RefinerEntry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
