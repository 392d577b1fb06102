//! Where ONNX Runtime and the installed models are found.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ort::environment::Environment;

use super::provider::Provider;

/// The folder that `make build` fills: `onnxruntime/` and `models/`.
#[derive(Debug, Clone)]
pub struct Assets {
    candidates: Vec<PathBuf>,
}

/// Why ONNX Runtime or a model is not there.
#[derive(Debug, thiserror::Error)]
pub enum RuntimeError {
    /// No shared library was found.
    #[error(
        "ONNX Runtime was not found ({looked}); run `make build` in the checkout, or set \
         ORT_DYLIB_PATH to a libonnxruntime of version 1.24 or later"
    )]
    NoLibrary {
        /// The places that were looked at.
        looked: String,
    },
    /// The library does not load.
    #[error(
        "ONNX Runtime at {path} cannot be loaded: {reason}; `make build` installs one that can"
    )]
    Library {
        /// The library.
        path: PathBuf,
        /// What the loader said.
        reason: String,
    },
    /// No such model is installed.
    #[error("the model {name:?} is not installed ({looked}); `make build` installs \"xfeat\"")]
    NoModel {
        /// The model.
        name: String,
        /// The places that were looked at.
        looked: String,
    },
}

impl Assets {
    /// The folder given, if any, and then the usual places: `assets` beside the binary or up to
    /// three folders above it (a checkout's `target/release`), and `/usr/lib/whereabouts`.
    pub fn locate(configured: Option<&Path>) -> Self {
        let binary = std::env::current_exe().unwrap_or_default();
        let beside = binary.ancestors().skip(1).take(4).map(|folder| folder.join("assets"));
        let installed = PathBuf::from("/usr/lib/whereabouts");
        let configured = configured.map(Path::to_owned);
        Self { candidates: configured.into_iter().chain(beside).chain([installed]).collect() }
    }

    /// The folder of the model called `name`.
    pub fn model(&self, name: &str) -> Result<PathBuf, RuntimeError> {
        let plain = !name.is_empty() && !name.contains(['/', '\\']) && name != "..";
        let folders = self.candidates.iter().map(|folder| folder.join("models").join(name));
        folders
            .into_iter()
            .find(|folder| plain && folder.join("manifest.toml").is_file())
            .ok_or_else(|| RuntimeError::NoModel { name: name.to_owned(), looked: self.looked() })
    }

    /// Loads ONNX Runtime: `ORT_DYLIB_PATH` if set, else the library among the assets; the one with
    /// OpenVINO, if it is there and may be wanted.
    pub fn load_onnxruntime(
        &self,
        provider: Option<Provider>,
    ) -> Result<Arc<Environment>, RuntimeError> {
        // ONNX Runtime allows one environment in a process, whoever asks; once made, it stays.
        static LOADED: Mutex<Option<Arc<Environment>>> = Mutex::new(None);
        let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(environment) = loaded.as_ref() {
            return Ok(Arc::clone(environment));
        }
        let path = self.onnxruntime(provider)?;
        let failed = |reason: String| RuntimeError::Library { path: path.clone(), reason };
        let environment = ort::init_from(&path)
            .map_err(|error| failed(error.to_string()))?
            .with_name("whereabouts")
            .with_telemetry(false)
            .build()
            .map_err(|error| failed(error.to_string()))?;
        let environment = Arc::new(environment);
        *loaded = Some(Arc::clone(&environment));
        Ok(environment)
    }

    fn onnxruntime(&self, provider: Option<Provider>) -> Result<PathBuf, RuntimeError> {
        if let Some(path) = std::env::var_os("ORT_DYLIB_PATH").filter(|path| !path.is_empty()) {
            return Ok(path.into());
        }
        let name =
            format!("{}onnxruntime{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
        let folders: &[&str] = match provider {
            None | Some(Provider::OpenVino) => &["onnxruntime-openvino", "onnxruntime"],
            Some(_) => &["onnxruntime"],
        };
        folders
            .iter()
            .flat_map(|folder| self.candidates.iter().map(move |assets| assets.join(folder)))
            .map(|folder| folder.join(&name))
            .find(|path| path.is_file())
            .ok_or_else(|| RuntimeError::NoLibrary { looked: self.looked() })
    }

    fn looked(&self) -> String {
        let places: Vec<_> =
            self.candidates.iter().map(|path| path.display().to_string()).collect();
        format!("looked in {}", places.join(", "))
    }
}
