//! What was found for each query, kept on disk so that a run that was killed goes on.

use std::collections::HashMap;
use std::fs::File;
use std::io::Write;
use std::path::Path;

use anyhow::Context;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};

use super::Method;
use whereabouts_core::{Description, Digest, ImageId, Usage};

/// What one method found for one query.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// The query.
    pub query: ImageId,
    /// Its bytes.
    pub digest: Digest,
    /// The references, best first.
    pub answers: Vec<Prediction>,
    /// How sure the first of them is, 0 to 1.
    pub confidence: f32,
    /// What a refiner said of the pairs.
    pub descriptions: Vec<Description>,
    /// Why the order is as it is.
    pub reasoning: Option<String>,
    /// What it cost.
    pub usage: Usage,
    /// How long it took.
    pub times: Times,
    /// Why part of a refined order, or all of it, is the coarse one.
    pub degraded: Option<String>,
}

/// One reference in an answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// The reference.
    pub image_id: ImageId,
    /// Cosine similarity of its descriptor to the query's, −1 to 1.
    pub similarity: f32,
    /// Its place in the coarse order, from 1.
    pub coarse_rank: usize,
}

/// How long the stages took, in milliseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Times {
    /// Decoding and resizing.
    pub decode: f64,
    /// Inference and pooling.
    pub extract: f64,
    /// Search.
    pub search: f64,
    /// Refinement of all pairs; 0 for a coarse method.
    pub refine: f64,
    /// Pairs that were refined.
    pub pairs: usize,
}

/// What one method found for all queries, in their order.
#[derive(Debug, Clone)]
pub struct MethodOutcomes {
    /// The method.
    pub method: Method,
    /// One for each query.
    pub outcomes: Vec<Outcome>,
}

/// The outcomes of one method in a file of JSON lines.
///
/// Its name covers all that decides an outcome, so that a changed setting begins a new file.
pub(super) struct OutcomeCache {
    known: HashMap<(ImageId, Digest), Outcome>,
    file: Mutex<File>,
}

impl OutcomeCache {
    /// Reads what an earlier run left. A line that a kill cut short is passed over.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot use {}; choose another folder with --work", path.display());
        let text = match std::fs::read(path) {
            Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(error).with_context(cannot),
        };
        let known = text
            .lines()
            .filter_map(|line| serde_json::from_str::<Outcome>(line).ok())
            .map(|outcome| ((outcome.query.clone(), outcome.digest), outcome))
            .collect();
        let mut file = File::options().create(true).append(true).open(path).with_context(cannot)?;
        if !text.is_empty() && !text.ends_with('\n') {
            file.write_all(b"\n").with_context(cannot)?;
        }
        Ok(Self { known, file: Mutex::new(file) })
    }

    /// What an earlier run found for these bytes.
    pub fn get(&self, query: &ImageId, digest: Digest) -> Option<Outcome> {
        self.known.get(&(query.clone(), digest)).cloned()
    }

    /// Keeps an outcome; it is on disk when this returns. A degraded one is not kept: the next run
    /// tries again.
    pub fn keep(&self, outcome: &Outcome) -> anyhow::Result<()> {
        if outcome.degraded.is_some() {
            return Ok(());
        }
        let mut line = serde_json::to_vec(outcome)?;
        line.push(b'\n');
        let mut file = self.file.lock();
        file.write_all(&line).and_then(|()| file.sync_data()).context("cannot keep an outcome")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(query: &str) -> Outcome {
        Outcome {
            query: query.parse().unwrap(),
            digest: Digest::of(query.as_bytes()),
            answers: Vec::new(),
            confidence: 0.0,
            descriptions: Vec::new(),
            reasoning: None,
            usage: Usage::default(),
            times: Times::default(),
            degraded: None,
        }
    }

    #[test]
    fn what_was_kept_is_known_after_a_kill_in_the_middle_of_a_line() {
        let dir = tempfile::TempDir::new().unwrap();
        let file = dir.path().join("kept.jsonl");
        let kept = OutcomeCache::open(&file).unwrap();
        kept.keep(&outcome("a")).unwrap();
        kept.keep(&Outcome { degraded: Some("why".into()), ..outcome("b") }).unwrap();
        kept.keep(&outcome("c")).unwrap();
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() - 9]).unwrap();
        let kept = OutcomeCache::open(&file).unwrap();
        kept.keep(&outcome("d")).unwrap();
        let kept = OutcomeCache::open(&file).unwrap();
        let known =
            |name: &str| kept.get(&name.parse().unwrap(), Digest::of(name.as_bytes())).is_some();
        assert_eq!(["a", "b", "c", "d"].map(known), [true, false, false, true]);
        assert!(kept.get(&"a".parse().unwrap(), Digest::of(b"other bytes")).is_none());
    }

    #[test]
    fn what_is_read_again_is_what_was_measured_to_the_last_bit() {
        let dir = tempfile::TempDir::new().unwrap();
        let file = dir.path().join("kept.jsonl");
        let kept = OutcomeCache::open(&file).unwrap();
        let measured = |i: u32| {
            let ms = f64::from(i) * 1e-6;
            let times =
                Times { decode: ms / 3.0, extract: ms / 7.0, refine: ms, ..outcome("a").times };
            Outcome { times, ..outcome(&i.to_string()) }
        };
        let all: Vec<Outcome> = (0..200).map(|i| measured(i * 7919 + 1)).collect();
        all.iter().for_each(|outcome| kept.keep(outcome).unwrap());
        let kept = OutcomeCache::open(&file).unwrap();
        assert!(
            all.iter().all(|known| kept.get(&known.query, known.digest).as_ref() == Some(known))
        );
    }
}
