//! A cache of loaded models. Models are loaded on first use and evicted least recently used first.
//!
//! The cache is ours: those of moka and quick_cache grow past their limit if every entry is in use.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use super::decode::ImageLimits;
use super::execution::{Execution, ProviderPreference};
use super::extractor::{Extractor, ExtractorSettings};
use super::manifest::{MANIFEST, Manifest, Resize};
use super::runtime::{Assets, RuntimeError};
use parking_lot::{Mutex, MutexGuard};
use whereabouts_core::{DescriptorKind, Digest, Map, Precision};

/// How models are loaded and cached.
#[derive(Debug, Clone)]
pub struct LoadedSettings {
    /// Maximum models in memory. The least recently used idle model is evicted.
    pub max_loaded: usize,
    /// Folder in which the chosen execution of each model is cached.
    pub choice_dir: PathBuf,
    /// How each model is loaded. Its model is the default model; its precision, if set, applies to all
    /// models.
    pub extractor: ExtractorSettings,
}

/// Loaded models. Clones share the same cache.
#[derive(Debug, Clone)]
pub struct LoadedModels {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    assets: Assets,
    settings: LoadedSettings,
    /// Least recently used first.
    loaded: Mutex<Vec<Loaded>>,
    /// Held while a model is loaded, so that models are loaded one at a time and none twice.
    loading: tokio::sync::Mutex<()>,
}

#[derive(Debug)]
struct Loaded {
    extractor: Arc<Extractor>,
    files: FileStamps,
}

/// Sizes and modification times of a model's files. They differ if the model was reinstalled since it was
/// loaded.
#[derive(Debug, Clone, PartialEq, Eq)]
struct FileStamps(Vec<(u64, Option<SystemTime>)>);

/// Why a model cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The model is not installed.
    #[error(transparent)]
    NotInstalled(RuntimeError),
    /// The model cannot be loaded.
    #[error("the model {name:?} cannot be loaded: {why}")]
    Broken {
        /// Name of the model.
        name: String,
        /// Why it cannot be loaded.
        why: String,
    },
    /// The cache is full of models in use.
    #[error("all {0} models that may be in memory are in use (model.loaded)")]
    AllInUse(usize),
}

impl LoadedModels {
    /// Creates an empty cache.
    pub fn new(assets: Assets, settings: LoadedSettings) -> Self {
        let (loaded, loading) = (Mutex::default(), tokio::sync::Mutex::default());
        Self { shared: Arc::new(Shared { assets, settings, loaded, loading }) }
    }

    /// Names and executions of the models in memory, most recently used first.
    pub fn in_memory(&self) -> Vec<(String, Execution)> {
        let loaded = self.shared.loaded();
        let entry = |loaded: &Loaded| {
            (loaded.extractor.manifest().name.clone(), loaded.extractor.execution())
        };
        loaded.iter().rev().map(entry).collect()
    }

    /// The model of maps that are created without naming one.
    pub fn default_model(&self) -> &str {
        &self.shared.settings.extractor.model
    }

    /// Limits on the size of a picture.
    pub fn limits(&self) -> ImageLimits {
        self.shared.settings.extractor.limits
    }

    /// The precision required by the settings, if any.
    pub fn precision(&self) -> Option<Precision> {
        self.shared.settings.extractor.preference.precision
    }

    /// Reads the manifest of an installed model from disk.
    pub fn manifest(&self, name: &str) -> Result<Manifest, ModelError> {
        self.shared.manifest(name).map(|(_, manifest)| manifest)
    }

    /// Returns the model of a map. Prefers a loaded model with the map's digest and precision; otherwise
    /// loads the installed model of that name, at the map's precision unless the settings require another.
    pub async fn of(&self, map: &Map) -> Result<Arc<Extractor>, ModelError> {
        if let Some(extractor) = self.shared.find(|loaded| loaded.extractor.is_of(map)) {
            return Ok(extractor);
        }
        self.installed(&map.model, self.precision().or(Some(map.precision))).await
    }

    /// Returns the currently installed model of that name, at `precision` or, without one, at any precision.
    pub async fn installed(
        &self,
        name: &str,
        precision: Option<Precision>,
    ) -> Result<Arc<Extractor>, ModelError> {
        let (shared, name) = (Arc::clone(&self.shared), name.to_owned());
        // A separate task, so that a caller that leaves does not cancel a load that others wait for.
        let loading = tokio::spawn(async move {
            let _guard = shared.loading.lock().await;
            let (loader, model) = (Arc::clone(&shared), name.clone());
            tokio::task::spawn_blocking(move || loader.load(&model, precision))
                .await
                .unwrap_or_else(|error| Err(broken(&name, &error)))
        });
        loading.await.unwrap_or_else(|error| Err(broken("", &error)))
    }
}

impl Shared {
    /// Returns the currently installed model, from the cache or from disk. Blocks; the caller holds `loading`.
    fn load(&self, name: &str, precision: Option<Precision>) -> Result<Arc<Extractor>, ModelError> {
        let (folder, manifest) = self.manifest(name)?;
        let files = FileStamps::of(&[folder.join(MANIFEST), folder.join(&manifest.file)]);
        let matches = |loaded: &Loaded| {
            loaded.files == files
                && loaded.extractor.manifest().name == name
                && precision
                    .is_none_or(|required| loaded.extractor.execution().precision == required)
        };
        if let Some(extractor) = self.find(matches) {
            return Ok(extractor);
        }
        self.evict_if_full()?;
        let LoadedSettings { choice_dir, extractor, .. } = &self.settings;
        let settings = ExtractorSettings {
            model: name.to_owned(),
            preference: ProviderPreference { precision, ..extractor.preference },
            choice_file: Some(choice_dir.join(format!("inference-{name}.toml"))),
            ..extractor.clone()
        };
        let loaded = Extractor::load(&self.assets, &settings);
        let extractor = Arc::new(loaded.map_err(|error| broken(name, &error))?);
        let (digest, execution) = (extractor.identity(), extractor.execution());
        let input = &extractor.manifest().input;
        tracing::info!(model = name, %digest, %execution, %input, "model loaded");
        if input.resize == Resize::CentreCrop {
            tracing::warn!(
                model = name,
                "the manifest crops pictures to their centre, which a place may not be recognised by; `whereabouts model \
                 pull {name} --update` installs one that takes whole pictures, if this release has it"
            );
        }
        self.loaded().push(Loaded { extractor: Arc::clone(&extractor), files });
        Ok(extractor)
    }

    fn manifest(&self, name: &str) -> Result<(PathBuf, Manifest), ModelError> {
        let folder = self.assets.model(name).map_err(ModelError::NotInstalled)?;
        let manifest = self.assets.manifest(&folder).map_err(|e| broken(name, &e))?;
        if manifest.name != name {
            let why = format!(
                "the manifest in {} names {:?}; `whereabouts model add --name {name}` installs a \
                 model under another name",
                folder.display(),
                manifest.name
            );
            return Err(broken(name, &why));
        }
        Ok((folder, manifest))
    }

    /// Finds a loaded model and marks it as most recently used.
    fn find(&self, matches: impl Fn(&Loaded) -> bool) -> Option<Arc<Extractor>> {
        let mut loaded = self.loaded();
        let position = loaded.iter().position(matches)?;
        let used = loaded.remove(position);
        let extractor = Arc::clone(&used.extractor);
        loaded.push(used);
        Some(extractor)
    }

    /// Evicts the least recently used idle model if the cache is full.
    fn evict_if_full(&self) -> Result<(), ModelError> {
        let mut loaded = self.loaded();
        if loaded.len() < self.settings.max_loaded {
            return Ok(());
        }
        // References are handed out only under this lock, so an idle model stays idle.
        let idle = |loaded: &Loaded| Arc::strong_count(&loaded.extractor) == 1;
        let position = loaded.iter().position(idle);
        let position = position.ok_or(ModelError::AllInUse(self.settings.max_loaded))?;
        let evicted = loaded.remove(position).extractor;
        tracing::info!(model = evicted.manifest().name, "model evicted");
        Ok(())
    }

    fn loaded(&self) -> MutexGuard<'_, Vec<Loaded>> {
        self.loaded.lock()
    }
}

impl Extractor {
    /// Whether descriptors of this model are comparable to those of the map.
    pub fn is_of(&self, map: &Map) -> bool {
        self.manifest().name == map.model
            && self.digest_of(map) == Some(map.model_digest)
            && self.execution().precision == map.precision
    }

    /// The digest that a map's descriptors would have if they were made now.
    pub fn digest_of(&self, map: &Map) -> Option<Digest> {
        match &map.vocabulary {
            Some(own) => self.own_digest(map.descriptor, own.digest),
            None => self.digest(map.descriptor),
        }
    }

    /// Identifies the model and precision, so that dense features of different models are not mixed.
    pub fn identity(&self) -> Digest {
        // The one kind that every model has: dense features do not depend on how they are pooled.
        let digest = self.digest(DescriptorKind::GEM).unwrap_or_else(|| Digest::of(b""));
        let precision = self.execution().precision;
        Digest::of(format!("{digest} at {precision} precision").as_bytes())
    }
}

impl FileStamps {
    fn of(paths: &[PathBuf]) -> Self {
        let stamp = |path: &PathBuf| {
            let metadata = Path::metadata(path).ok();
            metadata.map_or((0, None), |metadata| (metadata.len(), metadata.modified().ok()))
        };
        Self(paths.iter().map(stamp).collect())
    }
}

fn broken(name: &str, why: &dyn std::fmt::Display) -> ModelError {
    ModelError::Broken { name: name.to_owned(), why: why.to_string() }
}
