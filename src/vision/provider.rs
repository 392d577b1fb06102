//! The choice of an execution: [`choose`] measures those that the machine supports. One is eligible only if the
//! cosine similarity of its descriptors to those of the CPU at full precision is at least [`MIN_SIMILARITY`]. The
//! sample pictures are street scenes, because tokens of noise resemble nothing that a model meets in use.

use std::path::Path;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::execution::{Execution, ProviderPreference};
use super::preprocess::Tensor;
use super::session::{InferenceError, Model, Runner};
use whereabouts_core::{Descriptor, Digest};

/// Minimum cosine similarity of the descriptors of an eligible execution to those of the CPU at full precision.
pub const MIN_SIMILARITY: f32 = 0.999;

/// The trial run of one execution.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// Execution that was tried.
    pub execution: Execution,
    /// The measurement, or why the execution is unusable.
    pub outcome: Result<Measurement, String>,
}

/// The measurement of one execution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Median latency of a single picture.
    pub latency: Duration,
    /// Lowest cosine similarity of a descriptor to that of the CPU at full precision.
    pub similarity: f32,
}

/// Tries every allowed execution on `sample`. Returns the fastest eligible one, and all trials.
pub(super) fn choose(
    model: &Model,
    preference: ProviderPreference,
    threads: usize,
    sample: &[Tensor],
) -> Result<(Execution, Vec<Trial>), InferenceError> {
    let candidates = Execution::candidates(preference);
    if candidates.is_empty() {
        return Err(InferenceError::Load(format!(
            "the loaded ONNX Runtime does not support {preference}; `make openvino` installs one with \
             OpenVINO, and model.provider = \"auto\" uses any provider that is available"
        )));
    }
    if let [only] = candidates.as_slice() {
        return Ok((*only, Vec::new()));
    }
    let reference = measure(model, Execution::REFERENCE, threads, sample)?;
    let mut trials = Vec::new();
    for execution in candidates {
        let outcome = if execution == Execution::REFERENCE {
            Ok(Measurement { latency: reference.latency, similarity: 1.0 })
        } else {
            let measured = measure(model, execution, threads, sample);
            measured.map_err(|error| error.to_string()).map(|run| Measurement {
                latency: run.latency,
                similarity: min_similarity(&run.descriptors, &reference.descriptors),
            })
        };
        trials.push(Trial { execution, outcome });
    }
    let eligible = trials.iter().filter_map(|trial| {
        let measured = trial.outcome.as_ref().ok()?;
        (measured.similarity >= MIN_SIMILARITY).then_some((trial.execution, measured.latency))
    });
    match eligible.min_by_key(|(_, latency)| *latency) {
        Some((fastest, _)) => Ok((fastest, trials)),
        None => Err(InferenceError::Load(format!(
            "no execution by {preference} computes descriptors close enough to the reference: {trials:?}"
        ))),
    }
}

struct SampleRun {
    latency: Duration,
    descriptors: Vec<Descriptor>,
}

fn measure(
    model: &Model,
    execution: Execution,
    threads: usize,
    sample: &[Tensor],
) -> Result<SampleRun, InferenceError> {
    /// A slow model is measured in fewer runs.
    const RUNS: std::ops::RangeInclusive<usize> = 3..=11;
    const ENOUGH_TIME: Duration = Duration::from_millis(500);
    let mut runner = model.load(execution, threads, 1)?;
    let descriptors = run_all(model, &mut runner, sample)?;
    let mut times: Vec<Duration> = Vec::with_capacity(*RUNS.end());
    for tensor in sample.iter().cycle().take(*RUNS.end()) {
        if times.len() >= *RUNS.start() && times.iter().sum::<Duration>() > ENOUGH_TIME {
            break;
        }
        let start = Instant::now();
        runner.run(&[tensor])?;
        times.push(start.elapsed());
    }
    times.sort();
    Ok(SampleRun { latency: times.get(times.len() / 2).copied().unwrap_or_default(), descriptors })
}

/// Computes the descriptors of `sample`, of every kind, by one execution on `threads` threads.
pub(super) fn descriptors(
    model: &Model,
    execution: Execution,
    threads: usize,
    sample: &[Tensor],
) -> Result<Vec<Descriptor>, InferenceError> {
    run_all(model, &mut model.load(execution, threads, 1)?, sample)
}

fn run_all(
    model: &Model,
    runner: &mut Runner,
    sample: &[Tensor],
) -> Result<Vec<Descriptor>, InferenceError> {
    let mut descriptors = Vec::new();
    for tensor in sample {
        let outputs = runner.run(&[tensor])?;
        let local = outputs
            .first()
            .ok_or_else(|| InferenceError::Run("the model returned no output".into()))?;
        for kind in model.kinds.names() {
            descriptors.push(model.kinds.descriptor(&kind.into(), local)?);
        }
    }
    Ok(descriptors)
}

/// The lowest pairwise cosine similarity of two lists of descriptors.
pub(super) fn min_similarity(descriptors: &[Descriptor], reference: &[Descriptor]) -> f32 {
    let pairs = descriptors.iter().zip(reference);
    pairs.map(|(descriptor, reference)| descriptor.similarity(reference)).fold(1.0, f32::min)
}

/// A fingerprint of the processor model and its features, if the system exposes them. A cached choice is not
/// used on another processor.
pub(super) fn processor() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let is_relevant =
        |line: &&str| ["model name", "flags", "Features"].iter().any(|name| line.starts_with(name));
    let lines: std::collections::BTreeSet<&str> = info.lines().filter(is_relevant).collect();
    let joined: Vec<&str> = lines.into_iter().collect();
    Digest::of(joined.join("\n").as_bytes()).hex()[..12].to_owned()
}

/// A choice made at an earlier start, cached so that later starts need not measure.
#[derive(Debug, Serialize, Deserialize)]
struct CachedChoice {
    /// Everything that the choice depends on.
    key: String,
    execution: Execution,
}

/// Reads the cached choice, if there is one for the same `key`.
pub(super) fn read_choice(file: &Path, key: &str) -> Option<Execution> {
    let cached: CachedChoice = toml::from_str(&std::fs::read_to_string(file).ok()?).ok()?;
    (cached.key == key).then_some(cached.execution)
}

/// Caches a choice. A failure is logged, and the next start measures again.
pub(super) fn write_choice(file: &Path, key: &str, execution: Execution) {
    let written = toml::to_string(&CachedChoice { key: key.to_owned(), execution })
        .map_err(|error| error.to_string())
        .and_then(|text| std::fs::write(file, text).map_err(|error| error.to_string()));
    if let Err(error) = written {
        tracing::warn!(file = %file.display(), error, "cannot cache the chosen execution");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::execution::Provider;
    use whereabouts_core::Precision;

    #[test]
    fn a_cached_choice_is_used_for_the_same_key_only() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let execution = Execution { provider: Provider::OpenVino, precision: Precision::Bf16 };
        assert_eq!(read_choice(file.path(), "a"), None);
        write_choice(file.path(), "a", execution);
        assert_eq!(read_choice(file.path(), "a"), Some(execution));
        assert_eq!(read_choice(file.path(), "b"), None);
        std::fs::write(file.path(), "rubbish").unwrap();
        assert_eq!(read_choice(file.path(), "a"), None);
    }
}
