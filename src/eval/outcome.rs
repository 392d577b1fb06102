//! The outcome of each query, cached on disk so that an interrupted run can be resumed.

use std::collections::HashMap;
use std::fs::File;
use std::io::Write;
use std::path::Path;

use anyhow::Context;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};

use super::Method;
use whereabouts_core::{Description, Digest, ImageId, Usage};

/// The outcome of one query with one method.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryOutcome {
    /// The query.
    pub query: ImageId,
    /// SHA-256 of the query's bytes.
    pub digest: Digest,
    /// The references, best first.
    #[serde(rename = "answers")]
    pub predictions: Vec<Prediction>,
    /// Confidence in the first prediction, 0 to 1; `None` if it cannot be measured, as in a map of one image.
    pub confidence: Option<f32>,
    /// What else could be taken for the confidence of a model's answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alternatives: Option<AlternativeConfidence>,
    /// The refiner's descriptions of the pairs.
    pub descriptions: Vec<Description>,
    /// The refiner's explanation of its ranking.
    pub reasoning: Option<String>,
    /// Calls and tokens spent.
    pub usage: Usage,
    /// Duration of the stages.
    pub times: StageTimes,
    /// Why the refined ranking is the coarse one, in part or as a whole; `None` if it was refined fully.
    pub degraded: Option<String>,
}

/// What else could be taken for the confidence of a model's answer, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AlternativeConfidence {
    /// The calibrated confidence of the similarity of the first prediction, as if no model had been asked.
    pub similarity: f32,
    /// The model's certainty taken at its word: `certain` is 1, `likely` 0.75, `unsure` 0.25, `none` 0; 0.5 if it says
    /// nothing.
    pub stated: f32,
}

/// A reference predicted to show the query's place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// The reference.
    pub image_id: ImageId,
    /// Cosine similarity of its descriptor and the query's, −1 to 1.
    pub similarity: f32,
    /// Rank in the coarse order, from 1.
    pub coarse_rank: usize,
}

/// Duration of the stages of one query, in milliseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct StageTimes {
    /// Decoding and resizing.
    pub decode: f64,
    /// Inference and pooling.
    pub extract: f64,
    /// Search.
    pub search: f64,
    /// Refinement of all pairs; 0 for a coarse method.
    pub refine: f64,
    /// Number of pairs refined.
    pub pairs: usize,
}

/// The outcomes of one method, in the order of the queries.
#[derive(Debug, Clone)]
pub struct MethodOutcomes {
    /// The method.
    pub method: Method,
    /// One outcome per query.
    pub outcomes: Vec<QueryOutcome>,
}

/// The outcomes of one method in a file of JSON lines.
///
/// The file name is a digest of everything that determines an outcome, so a changed setting begins a new file.
pub(super) struct OutcomeCache {
    cached: HashMap<(ImageId, Digest), QueryOutcome>,
    file: Mutex<File>,
}

impl OutcomeCache {
    /// Opens a file and reads the outcomes of earlier runs. A truncated line is ignored.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let context =
            || format!("cannot use {}; choose another folder with --work", path.display());
        let text = match std::fs::read(path) {
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(error).with_context(context),
        };
        let cached = text
            .lines()
            .filter_map(|line| serde_json::from_str::<QueryOutcome>(line).ok())
            .map(|outcome| ((outcome.query.clone(), outcome.digest), outcome))
            .collect();
        let mut file =
            File::options().create(true).append(true).open(path).with_context(context)?;
        if !text.is_empty() && !text.ends_with('\n') {
            file.write_all(b"\n").with_context(context)?;
        }
        Ok(Self { cached, file: Mutex::new(file) })
    }

    /// Returns the outcome of an earlier run for the same query with the same bytes.
    pub fn get(&self, query: &ImageId, digest: Digest) -> Option<QueryOutcome> {
        self.cached.get(&(query.clone(), digest)).cloned()
    }

    /// Writes an outcome to disk before it returns. A degraded one is not written, so that the next run tries
    /// again.
    pub fn insert(&self, outcome: &QueryOutcome) -> anyhow::Result<()> {
        if outcome.degraded.is_some() {
            return Ok(());
        }
        let mut line = serde_json::to_vec(outcome)?;
        line.push(b'\n');
        let mut file = self.file.lock();
        file.write_all(&line)
            .and_then(|()| file.sync_data())
            .context("cannot write an outcome to the work folder")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(query: &str) -> QueryOutcome {
        QueryOutcome {
            query: query.parse().unwrap(),
            digest: Digest::of(query.as_bytes()),
            predictions: Vec::new(),
            confidence: None,
            alternatives: None,
            descriptions: Vec::new(),
            reasoning: None,
            usage: Usage::default(),
            times: StageTimes::default(),
            degraded: None,
        }
    }

    #[test]
    fn a_truncated_line_and_degraded_outcomes_are_not_cached() {
        let dir = tempfile::TempDir::new().unwrap();
        let file = dir.path().join("outcomes.jsonl");
        let cache = OutcomeCache::open(&file).unwrap();
        cache.insert(&outcome("a")).unwrap();
        cache.insert(&QueryOutcome { degraded: Some("why".into()), ..outcome("b") }).unwrap();
        cache.insert(&outcome("c")).unwrap();
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() - 9]).unwrap();
        let cache = OutcomeCache::open(&file).unwrap();
        cache.insert(&outcome("d")).unwrap();
        let cache = OutcomeCache::open(&file).unwrap();
        let is_cached =
            |name: &str| cache.get(&name.parse().unwrap(), Digest::of(name.as_bytes())).is_some();
        assert_eq!(["a", "b", "c", "d"].map(is_cached), [true, false, false, true]);
        assert!(cache.get(&"a".parse().unwrap(), Digest::of(b"other bytes")).is_none());
    }

    #[test]
    fn a_cached_outcome_equals_the_measured_one_to_the_last_bit() {
        let dir = tempfile::TempDir::new().unwrap();
        let file = dir.path().join("outcomes.jsonl");
        let cache = OutcomeCache::open(&file).unwrap();
        let measured = |i: u32| {
            let ms = f64::from(i) * 1e-6;
            let times = StageTimes {
                decode: ms / 3.0,
                extract: ms / 7.0,
                refine: ms,
                ..outcome("a").times
            };
            QueryOutcome { times, ..outcome(&i.to_string()) }
        };
        let all: Vec<QueryOutcome> = (0..200).map(|i| measured(i * 7919 + 1)).collect();
        all.iter().for_each(|outcome| cache.insert(outcome).unwrap());
        let cache = OutcomeCache::open(&file).unwrap();
        assert!(all.iter().all(|one| cache.get(&one.query, one.digest).as_ref() == Some(one)));
    }

    #[test]
    fn the_file_of_an_earlier_version_can_be_read() {
        let line = serde_json::to_value(outcome("a")).unwrap();
        let keys: Vec<&String> = line.as_object().unwrap().keys().collect();
        let mut expected = [
            "query",
            "digest",
            "answers",
            "confidence",
            "descriptions",
            "reasoning",
            "usage",
            "times",
            "degraded",
        ];
        expected.sort_unstable();
        let mut keys: Vec<&str> = keys.into_iter().map(String::as_str).collect();
        keys.sort_unstable();
        assert_eq!(keys, expected);
    }
}
