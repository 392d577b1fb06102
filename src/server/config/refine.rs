//! Settings of refinement.

use serde::{Deserialize, Serialize};

use super::RefinerChoice;

/// `[refine]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Refine {
    /// Who refines.
    pub refiner: RefinerChoice,
    /// Further refiners that maps and requests may choose.
    pub allowed: Vec<RefinerChoice>,
    /// Candidates that `mllm` compares.
    pub candidates: usize,
    /// Candidates that `local` compares.
    pub local_candidates: usize,
    /// Memory for dense features, in bytes.
    pub dense_cache_bytes: usize,
}
