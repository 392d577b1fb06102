//! Answers to bulk uploads.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What became of many images.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchAnswer {
    /// Images that are new.
    pub stored: usize,
    /// Images that were there already.
    pub present: usize,
    /// Images that could not be stored.
    pub failed: usize,
    /// One for each image, in the order in which they came.
    pub results: Vec<BatchResult>,
}

/// What became of one of many images.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchResult {
    /// Its id, where one is known.
    #[schema(nullable)]
    pub id: Option<String>,
    /// What became of it.
    pub outcome: BatchOutcome,
    /// Why it could not be stored; else null.
    #[schema(nullable)]
    pub problem: Option<BatchProblem>,
}

/// What became of one of many images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum BatchOutcome {
    /// It is stored.
    Stored,
    /// It was there already.
    Present,
    /// It could not be stored.
    Failed,
}

/// Why an image could not be stored.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct BatchProblem {
    /// The kind: the word that ends the `type` of a problem.
    pub kind: String,
    /// What happened and what to do next.
    pub detail: String,
    /// When it is worth trying again, in seconds, where that is known.
    #[schema(nullable)]
    pub retry_after_s: Option<f64>,
}
