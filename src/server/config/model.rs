//! How pictures are decoded and the model is run.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use whereabouts_core::Precision;
use whereabouts_models::DownloadSettings;
use whereabouts_vision::{AdmissionSettings, Layout, Provider, ProviderPreference};

/// `[model]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    /// The model's name, or "auto".
    pub name: String,
    /// Who runs it.
    pub provider: ProviderWish,
    /// At which precision.
    pub precision: PrecisionWish,
    /// The most models in memory.
    pub loaded: usize,
    /// An assets folder to look in before the usual places; empty for none.
    pub assets: PathBuf,
    /// Threads of all inference; 0 for one a core.
    pub threads: usize,
    /// Pictures run side by side while several wait; 0 for one a thread.
    pub sessions: usize,
    /// The most pictures in one run.
    pub max_batch: usize,
    /// Where `whereabouts model pull` downloads from.
    pub hub: String,
    /// How long the demo waits for it to answer, in seconds; 0: it does not ask.
    pub hub_patience_s: u64,
    /// The largest file it downloads, in bytes.
    pub max_download_bytes: u64,
    /// The longest time without a byte, in seconds.
    pub download_stall_s: u64,
    /// How often it asks while nothing comes of it.
    pub download_attempts: u32,
    /// The pause before the second attempt, in milliseconds; it doubles each time.
    pub download_backoff_ms: u64,
}

impl Model {
    /// How inference shares its threads among pictures.
    pub fn layout(&self) -> Layout {
        let threads = cores_unless(self.threads);
        let sessions = if self.sessions == 0 { threads } else { self.sessions };
        Layout { threads, sessions, max_batch: self.max_batch }
    }

    /// What may be chosen from.
    pub fn wanted(&self) -> ProviderPreference {
        ProviderPreference {
            provider: match self.provider {
                ProviderWish::Auto => None,
                ProviderWish::Cpu => Some(Provider::Cpu),
                ProviderWish::OpenVino => Some(Provider::OpenVino),
                ProviderWish::Cuda => Some(Provider::Cuda),
                ProviderWish::TensorRt => Some(Provider::TensorRt),
                ProviderWish::CoreMl => Some(Provider::CoreMl),
            },
            precision: match self.precision {
                PrecisionWish::Auto => None,
                PrecisionWish::Full => Some(Precision::Full),
                PrecisionWish::Bf16 => Some(Precision::Bf16),
            },
        }
    }

    /// The folder to look in before the usual places, if there is one.
    pub fn assets(&self) -> Option<&Path> {
        Some(self.assets.as_path()).filter(|path| *path != Path::new(""))
    }

    /// Bounds on a download.
    pub fn download(&self) -> DownloadSettings {
        DownloadSettings {
            max_bytes: self.max_download_bytes,
            stall: Duration::from_secs(self.download_stall_s),
            attempts: self.download_attempts,
            backoff: Duration::from_millis(self.download_backoff_ms),
        }
    }
}

/// Who is to run the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProviderWish {
    /// The fastest that there is.
    Auto,
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

/// At which precision the model is to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PrecisionWish {
    /// That of the maps there are, else the fastest that gives the same descriptors.
    Auto,
    /// 32-bit floats.
    Full,
    /// 16-bit floats with 8 bits of exponent.
    Bf16,
}

/// `[image]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Image {
    /// The most pixels that are decoded.
    pub max_pixels: u64,
    /// Decoding threads; 0 for one a core.
    pub threads: usize,
    /// Pictures in work at a time; 0 for as many as keep decoding and inference busy.
    pub permits: usize,
    /// Pictures that may wait.
    pub queue: usize,
    /// For how long, in milliseconds.
    pub max_wait_ms: u64,
    /// The longest Retry-After, in seconds.
    pub max_retry_after_s: u64,
    /// Whether every pixel of a large JPEG is decoded before it is scaled down.
    pub exact: bool,
}

impl Image {
    /// Bounds on the pictures in work and waiting, where inference has this layout.
    pub fn admission(&self, layout: Layout) -> AdmissionSettings {
        let permits = match self.permits {
            // Each thread decodes one, and twice as many as are inferred have been decoded.
            0 => cores_unless(self.threads) + 2 * layout.sessions * layout.max_batch,
            permits => permits,
        };
        AdmissionSettings {
            permits,
            queue: self.queue,
            max_wait: Duration::from_millis(self.max_wait_ms),
            max_retry_after: Duration::from_secs(self.max_retry_after_s),
        }
    }
}

/// A number of threads, or where it is 0, one for each core.
pub fn cores_unless(threads: usize) -> usize {
    match threads {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        threads => threads,
    }
}
