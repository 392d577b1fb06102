//! Locating ONNX Runtime and the installed models.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ort::environment::Environment;
use parking_lot::Mutex;

use super::execution::Provider;
use super::input_sizes::InputSizes;
use super::manifest::{MANIFEST, Manifest, ManifestError};
use super::python;

/// The model name that [`Assets::resolve`] replaces by an installed model.
pub const AUTO: &str = "auto";

/// The file in `models/` that names the model to use for `auto`.
pub const CHOSEN: &str = "chosen";

/// Models that `auto` prefers over the built-in one. The smallest comes first because it has the lowest latency;
/// a larger one can be chosen explicitly.
pub const PREFERRED_MODELS: [&str; 3] = ["dinov2-small", "dinov2-base", "dinov2-large"];

/// The model that `make build` installs.
pub const BUILT_IN_MODEL: &str = "xfeat";

/// How the default model was selected.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum WhyModel {
    /// Named by a setting or a flag.
    Named,
    /// Named by this file, which `whereabouts model use` wrote.
    Chosen(PathBuf),
    /// The first of [`PREFERRED_MODELS`] that is installed.
    Preferred,
    /// The built-in model, because none of [`PREFERRED_MODELS`] is installed.
    BuiltIn,
}

impl fmt::Display for WhyModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Named => f.write_str("set by model.name"),
            Self::Chosen(file) => write!(f, "chosen in {}", file.display()),
            Self::Preferred => f.write_str("the first installed DINOv2 model"),
            Self::BuiltIn => f.write_str("built in; no DINOv2 is installed"),
        }
    }
}

/// The assets folders, which hold `onnxruntime/` and `models/` and are filled by `make build`.
#[derive(Debug, Clone)]
pub struct Assets {
    candidates: Vec<PathBuf>,
    /// Package folders of Python with an ONNX Runtime of their own.
    packages: Vec<PathBuf>,
    sizes: InputSizes,
}

/// Why ONNX Runtime or a model is unavailable.
#[derive(Debug, thiserror::Error)]
pub enum RuntimeError {
    /// The shared library was not found.
    #[error(
        "ONNX Runtime was not found (searched {searched}); run `make build` in the checkout, or `pip install \
         onnxruntime` where `whereabouts-vpr` is installed, or set ORT_DYLIB_PATH to a libonnxruntime of version \
         1.24 or later"
    )]
    NoLibrary {
        /// The folders that were searched.
        searched: String,
    },
    /// The shared library cannot be loaded.
    #[error(
        "ONNX Runtime at {path} cannot be loaded: {reason}; `make build` in the checkout installs one that can, or \
         `pip install 'onnxruntime>=1.24'` where `whereabouts-vpr` is installed"
    )]
    Library {
        /// Path of the library.
        path: PathBuf,
        /// Message of the loader.
        reason: String,
    },
    /// The model is not installed.
    #[error(
        "the model {name:?} is not installed (searched {searched}); `whereabouts model list` shows what can \
         be pulled, and `make build` installs \"xfeat\""
    )]
    NoModel {
        /// The model.
        name: String,
        /// The folders that were searched.
        searched: String,
    },
    /// The chosen model is not installed any more.
    #[error(
        "{file} names the model {name:?}, which is not installed; install it again, or run \
         `whereabouts model use auto`"
    )]
    ChosenIsGone {
        /// The model.
        name: String,
        /// The file that names it.
        file: PathBuf,
    },
}

impl Assets {
    /// Searches the configured folder, if any, and then the default locations: `assets` next to the binary
    /// or up to three folders above it (for a checkout's `target/release`), the Python package `whereabouts`
    /// if pip installed the binary, and `/usr/lib/whereabouts`.
    pub fn locate(configured: Option<&Path>) -> Self {
        let binary = std::env::current_exe().unwrap_or_default();
        let next_to_binary = binary.ancestors().skip(1).take(4).map(|folder| folder.join("assets"));
        let installed = PathBuf::from("/usr/lib/whereabouts");
        let configured = configured.map(Path::to_owned);
        let packages = python::package_folders(&binary);
        let of_python = packages.iter().map(|packages| python::assets(packages));
        let candidates = configured.into_iter().chain(next_to_binary).chain(of_python);
        Self {
            candidates: candidates.chain([installed]).collect(),
            packages,
            sizes: InputSizes::default(),
        }
    }

    /// The same, with sizes of pictures that replace those of manifests.
    #[must_use]
    pub fn with_sizes(self, sizes: InputSizes) -> Self {
        Self { sizes, ..self }
    }

    /// Reads the manifest of the model in `folder`, which may be yet to be installed, with the size that is set for it.
    pub fn manifest(&self, folder: &Path) -> Result<Manifest, ManifestError> {
        self.sizes.apply(Manifest::read(&folder.join(MANIFEST))?)
    }

    /// Finds the folder of the model called `name`.
    pub fn model(&self, name: &str) -> Result<PathBuf, RuntimeError> {
        self.folder(name, MANIFEST).ok_or_else(|| RuntimeError::NoModel {
            name: name.to_owned(),
            searched: self.searched(),
        })
    }

    /// Finds the folder of this name in `models/` that has this manifest.
    pub fn folder(&self, name: &str, manifest: &str) -> Option<PathBuf> {
        let is_plain = !name.is_empty() && !name.contains(['/', '\\']) && name != "..";
        let mut folders = self.candidates.iter().map(|folder| folder.join("models").join(name));
        folders.find(|folder| is_plain && folder.join(manifest).is_file())
    }

    /// Resolves a model name. [`AUTO`] becomes the chosen model, else the first of [`PREFERRED_MODELS`] that
    /// is installed, else the built-in model. Any other name is returned unchanged.
    pub fn resolve(&self, name: &str) -> Result<(String, WhyModel), RuntimeError> {
        if name != AUTO {
            return Ok((name.to_owned(), WhyModel::Named));
        }
        if let Some((file, name)) = self.chosen() {
            return match self.model(&name) {
                Ok(_) => Ok((name, WhyModel::Chosen(file))),
                Err(_) => Err(RuntimeError::ChosenIsGone { name, file }),
            };
        }
        let preferred = PREFERRED_MODELS.into_iter().find(|name| self.model(name).is_ok());
        Ok(match preferred {
            Some(name) => (name.to_owned(), WhyModel::Preferred),
            None => (BUILT_IN_MODEL.to_owned(), WhyModel::BuiltIn),
        })
    }

    /// The file that chooses a model, and the name in it.
    pub fn chosen(&self) -> Option<(PathBuf, String)> {
        self.candidates.iter().find_map(|folder| {
            let file = folder.join("models").join(CHOSEN);
            let name = std::fs::read_to_string(&file).ok()?.trim().to_owned();
            Some((file, name))
        })
    }

    /// All installed models and their folders, by name.
    pub fn installed(&self) -> BTreeMap<String, PathBuf> {
        let entries = self
            .candidates
            .iter()
            .rev()
            .filter_map(|folder| std::fs::read_dir(folder.join("models")).ok());
        let folders = entries.flatten().flatten().map(|entry| entry.path());
        folders
            .filter(|folder| folder.join(MANIFEST).is_file())
            .filter_map(|folder| Some((folder.file_name()?.to_str()?.to_owned(), folder)))
            .collect()
    }

    /// The folders that are searched, in order of precedence.
    pub fn candidates(&self) -> &[PathBuf] {
        &self.candidates
    }

    /// Loads ONNX Runtime from `ORT_DYLIB_PATH` if set, else from the assets. A build with OpenVINO is
    /// preferred if it is installed and `provider` allows OpenVINO.
    pub fn load_onnxruntime(
        &self,
        provider: Option<Provider>,
    ) -> Result<Arc<Environment>, RuntimeError> {
        // ONNX Runtime allows a single environment per process, which lives until exit.
        static LOADED: Mutex<Option<Arc<Environment>>> = Mutex::new(None);
        let mut loaded = LOADED.lock();
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
            .or_else(|| self.packages.iter().find_map(|packages| python::onnxruntime(packages)))
            .ok_or_else(|| RuntimeError::NoLibrary { searched: self.searched() })
    }

    /// The folders that are searched, for messages.
    pub fn searched(&self) -> String {
        let folders = self.candidates.iter().chain(&self.packages);
        folders.map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// Isolated assets, without those of the checkout.
    fn assets(models: &[&str]) -> (tempfile::TempDir, Assets) {
        let dir = tempfile::tempdir().unwrap();
        for model in models {
            let folder = dir.path().join("models").join(model);
            fs::create_dir_all(&folder).unwrap();
            fs::write(folder.join(MANIFEST), "").unwrap();
        }
        let candidates = vec![dir.path().to_owned()];
        let assets = Assets { candidates, packages: Vec::new(), sizes: InputSizes::default() };
        (dir, assets)
    }

    #[test]
    fn auto_resolves_to_the_smallest_dinov2_or_the_built_in_model() {
        for (installed, expected, why) in [
            (&["xfeat"][..], "xfeat", WhyModel::BuiltIn),
            (&["xfeat", "dinov2-large"], "dinov2-large", WhyModel::Preferred),
            (&["xfeat", "dinov2-base", "dinov2-small"], "dinov2-small", WhyModel::Preferred),
        ] {
            let (_dir, assets) = assets(installed);
            assert_eq!(assets.resolve(AUTO).unwrap(), (expected.to_owned(), why));
        }
    }

    #[test]
    fn a_name_overrides_the_choice_and_the_choice_overrides_the_preferences() {
        let (dir, assets) = assets(&["xfeat", "dinov2-small"]);
        let chosen = dir.path().join("models").join(CHOSEN);
        fs::write(&chosen, "xfeat\n").unwrap();
        let choice = ("xfeat".to_owned(), WhyModel::Chosen(chosen));
        assert_eq!(assets.resolve(AUTO).unwrap(), choice);
        let named = ("dinov2-small".to_owned(), WhyModel::Named);
        assert_eq!(assets.resolve("dinov2-small").unwrap(), named);
        assert_eq!(assets.installed().len(), 2);
    }

    #[test]
    fn a_chosen_model_that_was_removed_is_an_error() {
        let (dir, assets) = assets(&["xfeat"]);
        fs::write(dir.path().join("models").join(CHOSEN), "gone").unwrap();
        let error = assets.resolve(AUTO).unwrap_err().to_string();
        assert!(error.contains("\"gone\"") && error.contains("model use auto"), "{error}");
    }
}
