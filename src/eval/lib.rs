//! How often the service is right, measured on a folder of references and a folder of queries.
//!
//! | file | what it does |
//! |---|---|
//! | `folder`, `poses`, `truth`, `dataset` | the pictures, and which references are true for which query |
//! | `map`, `run`, `outcome` | indexes, retrieves and refines with the parts of the service, and keeps what was found |
//! | `recall`, `resample`, `open_set` | Recall@K, bootstrap intervals, known and unknown places |
//! | `summary`, `table`, `predictions` | the outcome as JSON, as the field's table, as CSV |
//! | `report` | the outcome as a page with pictures |
//!
//! There is no second pipeline: descriptors, search, refiners and the cache of descriptions are those
//! of the [`whereabouts_service`], in a data folder that a server could serve.

mod cache_key;
mod dataset;
mod folder;
mod map;
pub mod open_set;
mod outcome;
mod poses;
pub mod predictions;
pub mod recall;
pub mod report;
pub mod resample;
mod run;
mod summary;
mod table;
mod truth;

#[cfg(test)]
mod tests;

pub use dataset::{Dataset, EvaluatedQuery, Folders, QueryKind, Sampling};
pub use folder::{PictureFile, pictures};
pub use outcome::{MethodOutcomes, Outcome, Prediction, Times};
pub use poses::PoseSource;
pub use run::{Evaluator, Method, RunSettings, Watch};
pub use summary::{MethodSummary, RunConditions, Summary};
pub use table::table;
pub use truth::TruthSource;
