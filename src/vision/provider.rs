//! Where a model runs: by which execution provider of ONNX Runtime, and at which precision.
//!
//! [`choose`] measures what the machine has. A faster choice is taken only if its descriptors stay
//! within [`MIN_SIMILARITY`] of those of the CPU at full precision, on pictures of streets rather
//! than on noise, whose tokens resemble nothing that a model meets.

use std::path::Path;
use std::time::{Duration, Instant};

use ort::ep::{ArbitrarilyConfigurableExecutionProvider, ExecutionProvider, OpenVINO};
use ort::ep::{CUDA, CoreML, ExecutionProviderDispatch, TensorRT};
use serde::{Deserialize, Serialize};

use super::manifest::Manifest;
use super::preprocess::Tensor;
use super::session::{InferenceError, Model, Runner};
use whereabouts_core::{Descriptor, DescriptorKind, Digest, Precision};

/// The least cosine similarity between a descriptor of a faster choice and that of the CPU at full
/// precision.
pub const MIN_SIMILARITY: f32 = 0.999;

/// Who runs a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Provider {
    /// ONNX Runtime itself.
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

/// Who runs a model, and at which precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Execution {
    /// Who runs it.
    pub provider: Provider,
    /// At which precision.
    pub precision: Precision,
}

/// What may be chosen from; `None` for anything.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ProviderPreference {
    /// The provider.
    pub provider: Option<Provider>,
    /// The precision.
    pub precision: Option<Precision>,
}

/// One execution that was tried.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// What was tried.
    pub execution: Execution,
    /// What came of it.
    pub outcome: Result<Measurement, String>,
}

/// What one execution does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// The median time of one picture alone, of a few.
    pub latency: Duration,
    /// The least cosine similarity of a descriptor to that of the CPU at full precision.
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
    /// What every machine can do, and what the others are measured by.
    pub const REFERENCE: Self = Self { provider: Provider::Cpu, precision: Precision::Full };

    /// What can be tried for a wish, given what the library was built with.
    pub(super) fn candidates(wanted: ProviderPreference) -> Vec<Self> {
        const ALL: [Execution; 6] = [
            Execution::REFERENCE,
            Execution { provider: Provider::OpenVino, precision: Precision::Full },
            Execution { provider: Provider::OpenVino, precision: Precision::Bf16 },
            Execution { provider: Provider::Cuda, precision: Precision::Full },
            Execution { provider: Provider::TensorRt, precision: Precision::Full },
            Execution { provider: Provider::CoreMl, precision: Precision::Full },
        ];
        let fits = |execution: &Execution| {
            wanted.provider.is_none_or(|provider| provider == execution.provider)
                && wanted.precision.is_none_or(|precision| precision == execution.precision)
        };
        ALL.into_iter().filter(fits).filter(|execution| execution.provider.is_built_in()).collect()
    }

    /// How a session is told; `None` for the CPU, which needs no telling.
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
                    // It would pin the threads of sessions side by side to the same cores.
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
        // Else ONNX Runtime falls back to the CPU without a word.
        Some(dispatch.error_on_failure())
    }
}

impl Provider {
    /// Whether the library that was loaded has it.
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

/// Tries all that a wish allows on `sample`, and returns the fastest whose descriptors are right,
/// with all trials.
pub(super) fn choose(
    model: &Model,
    wanted: ProviderPreference,
    threads: usize,
    sample: &[Tensor],
) -> Result<(Execution, Vec<Trial>), InferenceError> {
    let candidates = Execution::candidates(wanted);
    if candidates.is_empty() {
        return Err(InferenceError::Load(format!(
            "the ONNX Runtime in use cannot run a model by {wanted}; `make openvino` installs one \
             with OpenVINO, and model.provider = \"auto\" takes what there is"
        )));
    }
    if let [only] = candidates.as_slice() {
        return Ok((*only, Vec::new()));
    }
    let reference = try_one(model, Execution::REFERENCE, threads, sample)?;
    let mut trials = Vec::new();
    for execution in candidates {
        let outcome = if execution == Execution::REFERENCE {
            Ok(Measurement { latency: reference.latency, similarity: 1.0 })
        } else {
            try_one(model, execution, threads, sample).map_err(|error| error.to_string()).map(
                |tried| Measurement {
                    latency: tried.latency,
                    similarity: least_similarity(&tried.descriptors, &reference.descriptors),
                },
            )
        };
        trials.push(Trial { execution, outcome });
    }
    let right = trials.iter().filter_map(|trial| {
        let measured = trial.outcome.as_ref().ok()?;
        (measured.similarity >= MIN_SIMILARITY).then_some((trial.execution, measured.latency))
    });
    match right.min_by_key(|(_, latency)| *latency) {
        Some((fastest, _)) => Ok((fastest, trials)),
        None => Err(InferenceError::Load(format!(
            "no way to run the model by {wanted} gives the right descriptors: {trials:?}"
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

struct ProviderTrial {
    latency: Duration,
    descriptors: Vec<Descriptor>,
}

fn try_one(
    model: &Model,
    execution: Execution,
    threads: usize,
    sample: &[Tensor],
) -> Result<ProviderTrial, InferenceError> {
    /// A large model on a small machine shows what it does in fewer.
    const RUNS: std::ops::RangeInclusive<usize> = 3..=11;
    const LONG_ENOUGH: Duration = Duration::from_millis(500);
    let mut runner = model.load(execution, threads, 1)?;
    let descriptors = run_all(model, &mut runner, sample)?;
    let mut times: Vec<Duration> = Vec::with_capacity(*RUNS.end());
    for tensor in sample.iter().cycle().take(*RUNS.end()) {
        if times.len() >= *RUNS.start() && times.iter().sum::<Duration>() > LONG_ENOUGH {
            break;
        }
        let start = Instant::now();
        runner.run(std::slice::from_ref(tensor))?;
        times.push(start.elapsed());
    }
    times.sort();
    Ok(ProviderTrial {
        latency: times.get(times.len() / 2).copied().unwrap_or_default(),
        descriptors,
    })
}

/// The descriptors of `sample` by one execution on so many threads.
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
    let unfit = |error: super::pooling::PoolingError| InferenceError::Run(error.to_string());
    let Manifest { output, pooling, .. } = &*model.manifest;
    let one = |tensor: &Tensor| {
        let raw = runner.run(std::slice::from_ref(tensor))?;
        let raw =
            raw.first().ok_or_else(|| InferenceError::Run("the model gave nothing".into()))?;
        raw.local_features(output, output.cells(tensor))
            .and_then(|local| local.descriptor(DescriptorKind::Gem, pooling))
            .map_err(unfit)
    };
    sample.iter().map(one).collect()
}

/// The least cosine similarity of descriptors, pair by pair.
pub(super) fn least_similarity(tried: &[Descriptor], reference: &[Descriptor]) -> f32 {
    let pairs = tried.iter().zip(reference);
    pairs.map(|(tried, right)| tried.similarity(right)).fold(1.0, f32::min)
}

/// What tells this processor from one that computes in another way, where the system says so.
pub(super) fn processor() -> String {
    let told = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let names =
        |line: &&str| ["model name", "flags", "Features"].iter().any(|name| line.starts_with(name));
    let lines: std::collections::BTreeSet<&str> = told.lines().filter(names).collect();
    let joined: Vec<&str> = lines.into_iter().collect();
    Digest::of(joined.join("\n").as_bytes()).hex()[..12].to_owned()
}

/// A choice that was made earlier, so that a start need not measure again.
#[derive(Debug, Serialize, Deserialize)]
struct Remembered {
    /// All that the choice depends on.
    key: String,
    execution: Execution,
}

/// The choice that was made for the same `key`, if it is known.
pub(super) fn recall(file: &Path, key: &str) -> Option<Execution> {
    let remembered: Remembered = toml::from_str(&std::fs::read_to_string(file).ok()?).ok()?;
    (remembered.key == key).then_some(remembered.execution)
}

/// Remembers a choice; where that fails, the next start measures again.
pub(super) fn remember(file: &Path, key: &str, execution: Execution) {
    let written = toml::to_string(&Remembered { key: key.to_owned(), execution })
        .map_err(|error| error.to_string())
        .and_then(|text| std::fs::write(file, text).map_err(|error| error.to_string()));
    if let Err(error) = written {
        tracing::warn!(file = %file.display(), error, "the choice of a provider is not remembered");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_choice_is_recalled_for_the_same_key_only() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let execution = Execution { provider: Provider::OpenVino, precision: Precision::Bf16 };
        assert_eq!(recall(file.path(), "a"), None);
        remember(file.path(), "a", execution);
        assert_eq!(recall(file.path(), "a"), Some(execution));
        assert_eq!(recall(file.path(), "b"), None);
        std::fs::write(file.path(), "rubbish").unwrap();
        assert_eq!(recall(file.path(), "a"), None);
    }
}
