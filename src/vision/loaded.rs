//! The models in memory: loaded when they are first needed, no more than so many at a time.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use super::decode::ImageLimits;
use super::extractor::{Extractor, ExtractorSettings};
use super::manifest::{MANIFEST, Manifest};
use super::provider::{Execution, ProviderPreference};
use super::runtime::{Assets, RuntimeError};
use parking_lot::{Mutex, MutexGuard};
use whereabouts_core::{Digest, Map, Precision};

/// How models are kept in memory.
#[derive(Debug, Clone)]
pub struct LoadedSettings {
    /// The most models; one that nobody uses makes room, the least recently used first.
    pub max_loaded: usize,
    /// The folder where the choice of a provider is remembered for each model.
    pub choice_dir: PathBuf,
    /// How each of them is loaded. Its model is the default one; its precision, if there is one,
    /// holds for all.
    pub extractor: ExtractorSettings,
}

/// The models in memory. Clones share them.
#[derive(Debug, Clone)]
pub struct LoadedModels {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    assets: Assets,
    settings: LoadedSettings,
    /// The least recently used first.
    loaded: Mutex<Vec<Loaded>>,
    /// Held while a model is loaded, so that none is loaded twice, and not two at once.
    loading: tokio::sync::Mutex<()>,
}

#[derive(Debug)]
struct Loaded {
    extractor: Arc<Extractor>,
    files: Files,
}

/// Tells whether a model was installed anew since it was loaded.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Files(Vec<(u64, Option<SystemTime>)>);

/// Why a model cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// It is not installed.
    #[error(transparent)]
    NotInstalled(RuntimeError),
    /// It cannot be loaded.
    #[error("the model {name:?} cannot be loaded: {why}")]
    Broken {
        /// The model.
        name: String,
        /// Why not.
        why: String,
    },
    /// All that may be in memory are in use.
    #[error("{0} models are in use, the most that may be in memory (model.loaded)")]
    AllInUse(usize),
}

impl LoadedModels {
    /// None yet.
    pub fn new(assets: Assets, settings: LoadedSettings) -> Self {
        let (loaded, loading) = (Mutex::default(), tokio::sync::Mutex::default());
        Self { shared: Arc::new(Shared { assets, settings, loaded, loading }) }
    }

    /// Those in memory, the most recently used first: their names, and how they run.
    pub fn in_memory(&self) -> Vec<(String, Execution)> {
        let loaded = self.shared.loaded();
        let told = |loaded: &Loaded| {
            (loaded.extractor.manifest().name.clone(), loaded.extractor.execution())
        };
        loaded.iter().rev().map(told).collect()
    }

    /// The model of maps for which none is named.
    pub fn default_model(&self) -> &str {
        &self.shared.settings.extractor.model
    }

    /// Bounds on the pictures that models take.
    pub fn limits(&self) -> ImageLimits {
        self.shared.settings.extractor.limits
    }

    /// The precision that the settings prescribe, if any.
    pub fn precision(&self) -> Option<Precision> {
        self.shared.settings.extractor.preference.precision
    }

    /// What an installed model says about itself. Reads a file.
    pub fn manifest(&self, name: &str) -> Result<Manifest, ModelError> {
        self.shared.manifest(name).map(|(_, manifest)| manifest)
    }

    /// The model of a map: the very one, if it is in memory or installed; else the one of that name,
    /// as far as the settings allow in the map's precision.
    pub async fn of(&self, map: &Map) -> Result<Arc<Extractor>, ModelError> {
        if let Some(extractor) = self.shared.take(|loaded| loaded.extractor.is_of(map)) {
            return Ok(extractor);
        }
        self.installed(&map.model, self.precision().or(Some(map.precision))).await
    }

    /// The model of that name as it is installed now, at `precision`, or at any if there is none.
    pub async fn installed(
        &self,
        name: &str,
        precision: Option<Precision>,
    ) -> Result<Arc<Extractor>, ModelError> {
        let (shared, name) = (Arc::clone(&self.shared), name.to_owned());
        // A task of its own: a caller who leaves does not break off what others wait for.
        let loading = tokio::spawn(async move {
            let _alone = shared.loading.lock().await;
            let (loader, model) = (Arc::clone(&shared), name.clone());
            tokio::task::spawn_blocking(move || loader.load(&model, precision))
                .await
                .unwrap_or_else(|error| Err(broken(&name, &error)))
        });
        loading.await.unwrap_or_else(|error| Err(broken("", &error)))
    }
}

impl Shared {
    /// The model as it is installed now, from memory or from its files. Blocks; call it alone.
    fn load(&self, name: &str, precision: Option<Precision>) -> Result<Arc<Extractor>, ModelError> {
        let (folder, manifest) = self.manifest(name)?;
        let files = Files::of(&[folder.join(MANIFEST), folder.join(&manifest.file)]);
        let wanted = |loaded: &Loaded| {
            loaded.files == files
                && loaded.extractor.manifest().name == name
                && precision.is_none_or(|wanted| loaded.extractor.execution().precision == wanted)
        };
        if let Some(extractor) = self.take(wanted) {
            return Ok(extractor);
        }
        self.make_room()?;
        let LoadedSettings { choice_dir, extractor, .. } = &self.settings;
        let settings = ExtractorSettings {
            model: name.to_owned(),
            preference: ProviderPreference { precision, ..extractor.preference },
            choice_file: Some(choice_dir.join(format!("inference-{name}.toml"))),
            ..extractor.clone()
        };
        let loaded = Extractor::load(&self.assets, &settings);
        let extractor = Arc::new(loaded.map_err(|error| broken(name, &error))?);
        let (digest, execution) = (extractor.digest(), extractor.execution());
        tracing::info!(model = name, %digest, %execution, "model loaded");
        self.loaded().push(Loaded { extractor: Arc::clone(&extractor), files });
        Ok(extractor)
    }

    fn manifest(&self, name: &str) -> Result<(PathBuf, Manifest), ModelError> {
        let folder = self.assets.model(name).map_err(ModelError::NotInstalled)?;
        let manifest = Manifest::read(&folder.join(MANIFEST)).map_err(|e| broken(name, &e))?;
        if manifest.name != name {
            let why = format!(
                "the manifest in {} is of {:?}; `whereabouts model add --name {name}` installs a \
                 model under another name",
                folder.display(),
                manifest.name
            );
            return Err(broken(name, &why));
        }
        Ok((folder, manifest))
    }

    /// One that is in memory, and that is now the most recently used.
    fn take(&self, wanted: impl Fn(&Loaded) -> bool) -> Option<Arc<Extractor>> {
        let mut loaded = self.loaded();
        let place = loaded.iter().position(wanted)?;
        let used = loaded.remove(place);
        let extractor = Arc::clone(&used.extractor);
        loaded.push(used);
        Some(extractor)
    }

    /// Drops one that nobody uses, if one more would be too many.
    fn make_room(&self) -> Result<(), ModelError> {
        let mut loaded = self.loaded();
        if loaded.len() < self.settings.max_loaded {
            return Ok(());
        }
        // Only under this lock does anybody get hold of one.
        let idle = |loaded: &Loaded| Arc::strong_count(&loaded.extractor) == 1;
        let place = loaded.iter().position(idle);
        let place = place.ok_or(ModelError::AllInUse(self.settings.max_loaded))?;
        let dropped = loaded.remove(place).extractor;
        tracing::info!(model = dropped.manifest().name, "model dropped to make room");
        Ok(())
    }

    fn loaded(&self) -> MutexGuard<'_, Vec<Loaded>> {
        self.loaded.lock()
    }
}

impl Extractor {
    /// Whether it makes the descriptors that the map holds.
    pub fn is_of(&self, map: &Map) -> bool {
        self.manifest().name == map.model
            && self.digest() == map.model_digest
            && self.execution().precision == map.precision
    }

    /// Tells its dense features from those of any other model.
    pub fn identity(&self) -> Digest {
        let (digest, precision) = (self.digest(), self.execution().precision);
        Digest::of(format!("{digest} at {precision} precision").as_bytes())
    }
}

impl Files {
    fn of(paths: &[PathBuf]) -> Self {
        let seen = |path: &PathBuf| {
            let found = Path::metadata(path).ok();
            found.map_or((0, None), |found| (found.len(), found.modified().ok()))
        };
        Self(paths.iter().map(seen).collect())
    }
}

fn broken(name: &str, why: &dyn std::fmt::Display) -> ModelError {
    ModelError::Broken { name: name.to_owned(), why: why.to_string() }
}
