//! Execution: the provider of ONNX Runtime that runs a model, and its precision.

use ort::ep::{ArbitrarilyConfigurableExecutionProvider, ExecutionProvider, OpenVINO};
use ort::ep::{CUDA, CoreML, ExecutionProviderDispatch, TensorRT};
use serde::{Deserialize, Serialize};

use whereabouts_core::Precision;

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
