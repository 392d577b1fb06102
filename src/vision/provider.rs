//! Execution: the provider of ONNX Runtime that runs a model, and its precision.
//!
//! [`choose`] measures the executions that the machine supports. An execution is eligible only if the cosine
//! similarity of its descriptors to those of the CPU at full precision is at least [`MIN_SIMILARITY`]. The
//! sample pictures are street scenes, because tokens of noise resemble nothing that a model meets in use.

use std::path::Path;
use std::time::{Duration, Instant};

use ort::ep::{ArbitrarilyConfigurableExecutionProvider, ExecutionProvider, OpenVINO};
use ort::ep::{CUDA, CoreML, ExecutionProviderDispatch, TensorRT};
use serde::{Deserialize, Serialize};

use super::preprocess::Tensor;
use super::session::{InferenceError, Model, Runner};
use whereabouts_core::{Descriptor, DescriptorKind, Digest, Precision};

/// Minimum cosine similarity of the descriptors of an eligible execution to those of the CPU at full precision.
pub const MIN_SIMILARITY: f32 = 0.999;

/// An execution provider of ONNX Runtime.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Provider {
    /// The default CPU provider.
    Cpu,
    /// Intel's OpenVINO.
    OpenVino,
    /// NVIDIA's CUDA.
    Cuda,
    /// NVIDIA's TensorRT.
    TensorRt,
    /// Apple's Core ML.
    CoreMl,
}

/// An execution provider and a precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Execution {
    /// Execution provider.
    pub provider: Provider,
    /// Precision inside the model.
    pub precision: Precision,
}

/// Restricts the choice of an execution.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ProviderPreference {
    /// Required execution provider; `None` for any.
    pub provider: Option<Provider>,
    /// Required precision; `None` for any.
    pub precision: Option<Precision>,
}

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

impl std::fmt::Display for Provider {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Cpu => "cpu",
            Self::OpenVino => "openvino",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
            Self::CoreMl => "coreml",
        })
    }
}

impl std::fmt::Display for Execution {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} at {} precision", self.provider, self.precision)
    }
}

impl Execution {
    /// The execution that every machine supports, and to which the others are compared.
    pub const REFERENCE: Self = Self { provider: Provider::Cpu, precision: Precision::Full };

    /// The executions that `preference` allows and the loaded library supports.
    pub(super) fn candidates(preference: ProviderPreference) -> Vec<Self> {
        const ALL: [Execution; 6] = [
            Execution::REFERENCE,
            Execution { provider: Provider::OpenVino, precision: Precision::Full },
            Execution { provider: Provider::OpenVino, precision: Precision::Bf16 },
            Execution { provider: Provider::Cuda, precision: Precision::Full },
            Execution { provider: Provider::TensorRt, precision: Precision::Full },
            Execution { provider: Provider::CoreMl, precision: Precision::Full },
        ];
        let allowed = |execution: &Execution| {
            preference.provider.is_none_or(|provider| provider == execution.provider)
                && preference.precision.is_none_or(|precision| precision == execution.precision)
        };
        ALL.into_iter()
            .filter(allowed)
            .filter(|execution| execution.provider.is_built_in())
            .collect()
    }

    /// The registration of the provider with a session; `None` for the CPU, which is the default.
    pub(super) fn registration(self, threads: usize) -> Option<ExecutionProviderDispatch> {
        let dispatch = match self.provider {
            Provider::Cpu => return None,
            Provider::OpenVino => {
                let precision = match self.precision {
                    Precision::Full => "f32",
                    Precision::Bf16 => "bf16",
                };
                let config = serde_json::json!({"CPU": {
                    "INFERENCE_PRECISION_HINT": precision,
                    "PERFORMANCE_HINT": "LATENCY",
                    "INFERENCE_NUM_THREADS": threads.to_string(),
                    // Pinning would put the threads of concurrent sessions on the same cores.
                    "ENABLE_CPU_PINNING": "NO",
                }});
                OpenVINO::default()
                    .with_device_type("CPU")
                    .with_arbitrary_config("load_config", config)
                    .build()
            }
            Provider::Cuda => CUDA::default().build(),
            Provider::TensorRt => TensorRT::default().build(),
            Provider::CoreMl => CoreML::default().build(),
        };
        // Without this, ONNX Runtime falls back to the CPU silently.
        Some(dispatch.error_on_failure())
    }
}

impl Provider {
    /// Whether the loaded library was built with this provider.
    fn is_built_in(self) -> bool {
        let built_in = match self {
            Self::Cpu => return true,
            Self::OpenVino => OpenVINO::is_available(),
            Self::Cuda => CUDA::is_available(),
            Self::TensorRt => TensorRT::is_available(),
            Self::CoreMl => CoreML::is_available(),
        };
        built_in.unwrap_or(false)
    }
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

impl std::fmt::Display for ProviderPreference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.provider {
            Some(provider) => provider.fmt(f)?,
            None => f.write_str("any provider")?,
        }
        match self.precision {
            Some(precision) => write!(f, " at {precision} precision"),
            None => Ok(()),
        }
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

/// Computes the descriptors of `sample` by one execution on `threads` threads.
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
    let one = |tensor: &Tensor| {
        let outputs = runner.run(&[tensor])?;
        let local = outputs
            .first()
            .ok_or_else(|| InferenceError::Run("the model returned no output".into()))?;
        Ok(local.descriptor(DescriptorKind::Gem, &model.manifest.pooling)?)
    };
    sample.iter().map(one).collect()
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
