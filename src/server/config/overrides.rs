//! Settings that flags set.

use std::net::SocketAddr;
use std::path::PathBuf;

use serde::Serialize;

use super::{KeysWanted, RefinerChoice};

/// Settings from the command line, which go over all others.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Overrides {
    #[serde(skip_serializing_if = "Option::is_none")]
    server: Option<serde_json::Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    data: Option<serde_json::Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    model: Option<serde_json::Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    refine: Option<serde_json::Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mllm: Option<serde_json::Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    auth: Option<serde_json::Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    jobs: Option<serde_json::Value>,
}

impl Overrides {
    /// Sets `[server] listen`.
    pub fn listen(mut self, listen: Option<SocketAddr>) -> Self {
        self.server = listen.map(|listen| serde_json::json!({ "listen": listen }));
        self
    }

    /// Sets `[data] dir`.
    pub fn data(mut self, dir: Option<PathBuf>) -> Self {
        self.data = dir.map(|dir| serde_json::json!({ "dir": dir }));
        self
    }

    /// Sets `[model] name`.
    pub fn model(mut self, name: Option<String>) -> Self {
        self.model = name.map(|name| serde_json::json!({ "name": name }));
        self
    }

    /// Sets `[refine] refiner`.
    pub fn refiner(mut self, refiner: Option<RefinerChoice>) -> Self {
        self.refine = refiner.map(|refiner| serde_json::json!({ "refiner": refiner }));
        self
    }

    /// Sets `[auth] keys` to off.
    pub fn no_keys(mut self, off: bool) -> Self {
        self.auth = off.then(|| serde_json::json!({ "keys": KeysWanted::Off }));
        self
    }

    /// Sets `[jobs] workers` to 0.
    pub fn no_workers(mut self, none: bool) -> Self {
        self.jobs = none.then(|| serde_json::json!({ "workers": 0 }));
        self
    }

    /// Sets `[mllm] base_url`.
    pub fn mllm_base_url(mut self, url: Option<String>) -> Self {
        self.mllm = url.map(|url| serde_json::json!({ "base_url": url }));
        self
    }
}
