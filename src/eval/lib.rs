//! Measures Recall@K on a folder of references and a folder of queries, and reports it.
//!
//! | module | purpose |
//! |---|---|
//! | `folder`, `table_file`, `account`, `poses`, `truth`, `dataset` | the images, and the correct references of each query |
//! | `map`, `run`, `outcome` | index, retrieve and refine with the service, and cache the outcomes |
//! | `recall`, `resample`, `open_set` | Recall@K, bootstrap intervals, open-set metrics |
//! | `summary`, `table`, `predictions` | the results as JSON, as a table, as CSV |
//! | `report` | the results as an HTML page with example images |
//!
//! There is no second pipeline: descriptors, search, refiners and the cache of descriptions are those
//! of [`whereabouts_service`], on a data folder that a server could serve.

pub mod account;
mod cache_key;
mod dataset;
mod folder;
mod map;
mod natural;
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
mod table_file;
mod truth;

#[cfg(test)]
mod tests;

pub use dataset::{Dataset, EvaluatedQuery, Folders, LeftOut, QueryKind, Sampling};
pub use folder::{Folder, PictureFile, SkippedFile};
pub use outcome::{AlternativeConfidence, MethodOutcomes, Prediction, QueryOutcome, StageTimes};
pub use poses::{
    FolderPoses, FoundPose, LooseRow, MatchKind, PoseSource, RowAccount, UNUSED_DESCRIPTION,
    UnmatchedRow, zone_in_name,
};
pub use run::{Evaluator, Method, Observer, RunSettings};
pub use summary::{KnownAlternatives, MethodSummary, RunConditions, Summary};
pub use table::table;
pub use truth::{GroundTruth, TruthSource};
