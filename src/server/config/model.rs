//! Settings of the model and of downloading models.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use whereabouts_core::Precision;
use whereabouts_models::DownloadSettings;
use whereabouts_vision::{
    Assets, InputSizes, Layout, Provider, ProviderPreference, auto, threads_or_cores,
};

/// `[model]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    /// Name of the default model, or "auto".
    pub name: String,
    /// Execution provider; `None` for the fastest.
    #[serde(with = "auto")]
    pub provider: Option<Provider>,
    /// Precision; `None` for that of the maps, or else the fastest whose descriptors agree.
    #[serde(with = "auto")]
    pub precision: Option<Precision>,
    /// Maximum models in memory.
    pub loaded: usize,
    /// Sizes of pictures that replace those of manifests.
    pub sizes: InputSizes,
    /// An assets folder that is searched before the default locations; empty for none.
    pub assets: PathBuf,
    /// Total inference threads; 0 for one per core.
    pub threads: usize,
    /// Concurrent sessions under load; 0 for one per thread.
    pub sessions: usize,
    /// Maximum pictures per batch.
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
    /// How inference divides its threads among sessions.
    pub fn layout(&self) -> Layout {
        let threads = threads_or_cores(self.threads);
        let sessions = if self.sessions == 0 { threads } else { self.sessions };
        Layout { threads, sessions, max_batch: self.max_batch }
    }

    /// Restricts the choice of an execution.
    pub fn preference(&self) -> ProviderPreference {
        ProviderPreference { provider: self.provider, precision: self.precision }
    }

    /// The assets folder that is searched before the default locations, if one is set.
    pub fn assets(&self) -> Option<&Path> {
        Some(self.assets.as_path()).filter(|path| *path != Path::new(""))
    }

    /// The models in the assets folders, in `dir` first.
    pub fn installed_in(&self, dir: Option<&Path>) -> Assets {
        Assets::locate(dir.or(self.assets())).with_sizes(self.sizes.clone())
    }

    /// Limits and retries of a download.
    pub fn download(&self) -> DownloadSettings {
        DownloadSettings {
            max_bytes: self.max_download_bytes,
            stall: Duration::from_secs(self.download_stall_s),
            attempts: self.download_attempts,
            backoff: Duration::from_millis(self.download_backoff_ms),
        }
    }
}
