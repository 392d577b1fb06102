//! The catalogue of models that can be pulled by name.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use whereabouts_vision::{Manifest, ManifestError};

const BUILT_IN: &str = include_str!("../../deploy/models/catalogue.toml");

/// The models that can be pulled.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Catalogue {
    #[serde(rename = "model", default)]
    entries: Vec<Entry>,
}

/// One model on a hub.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Repository on the hub, as `owner/name`.
    pub repository: String,
    /// Commit, branch or tag of the repository.
    pub revision: String,
    /// Path of the ONNX file in the repository.
    pub path: String,
    /// Size of the ONNX file in bytes, if known.
    pub bytes: Option<u64>,
    /// Notes on the licence beyond its name.
    pub licence_note: Option<String>,
    /// The manifest installed with the file. Its `sha256` pins the file, if set.
    pub manifest: Manifest,
}

/// Why a catalogue is invalid.
#[derive(Debug, thiserror::Error)]
pub enum CatalogueError {
    /// The file cannot be read.
    #[error("cannot read the catalogue {path}: {source}")]
    Read {
        /// Path of the catalogue.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// The file is not a catalogue.
    #[error("{path} is not a model catalogue: {detail}")]
    Malformed {
        /// Path of the catalogue.
        path: PathBuf,
        /// Message of the parser.
        detail: String,
    },
    /// The manifest of an entry is invalid.
    #[error("in the catalogue, {0}")]
    Manifest(#[from] ManifestError),
}

impl Catalogue {
    /// The catalogue bundled with this release.
    pub fn built_in() -> Result<Self, CatalogueError> {
        Self::parse(BUILT_IN, Path::new("deploy/models/catalogue.toml"))
    }

    /// Reads the catalogue in `file`, or returns the bundled one.
    pub fn of(file: Option<&Path>) -> Result<Self, CatalogueError> {
        file.map_or_else(Self::built_in, Self::read)
    }

    /// Reads a catalogue file.
    pub fn read(path: &Path) -> Result<Self, CatalogueError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| CatalogueError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    fn parse(text: &str, path: &Path) -> Result<Self, CatalogueError> {
        let catalogue: Self = toml::from_str(text).map_err(|error| CatalogueError::Malformed {
            path: path.to_owned(),
            detail: error.to_string(),
        })?;
        for entry in &catalogue.entries {
            entry.manifest.check(Path::new(entry.name()))?;
        }
        Ok(catalogue)
    }

    /// All entries, in the order of the file.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Finds the entry of the model called `name`.
    pub fn find(&self, name: &str) -> Option<&Entry> {
        self.entries.iter().find(|entry| entry.name() == name)
    }
}

impl Entry {
    /// Name of the model.
    pub fn name(&self) -> &str {
        &self.manifest.name
    }

    /// The URL of one of the model's files on `hub`. The ONNX file may have another name there; files of
    /// external weights keep theirs, because the ONNX file references them by name.
    pub fn url(&self, hub: &str, file: &Path) -> String {
        let Self { repository, revision, path, manifest, .. } = self;
        let path = match path.rsplit_once('/') {
            _ if file == manifest.file => path.clone(),
            Some((folder, _)) => format!("{folder}/{}", file.display()),
            None => file.display().to_string(),
        };
        format!("{}/{repository}/resolve/{revision}/{path}", hub.trim_end_matches('/'))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::DescriptorKind;
    use whereabouts_vision::PREFERRED_MODELS;

    #[test]
    fn every_entry_is_consistent_and_states_its_licence() {
        let catalogue = Catalogue::built_in().unwrap();
        for entry in catalogue.entries() {
            let manifest = &entry.manifest;
            assert_eq!(manifest.licence, "Apache-2.0", "{}", entry.name());
            assert_eq!(manifest.dimension(DescriptorKind::CLS), Some(manifest.output.channels));
            let named = |other: &&Entry| other.name() == entry.name();
            assert_eq!(catalogue.entries().iter().filter(named).count(), 1);
            assert!(entry.revision != "main" || manifest.sha256.is_none(), "a branch moves");
        }
    }

    #[test]
    fn every_model_that_auto_prefers_can_be_pulled() {
        let catalogue = Catalogue::built_in().unwrap();
        for name in PREFERRED_MODELS {
            assert!(catalogue.find(name).is_some(), "{name}");
        }
        let dimensions = PREFERRED_MODELS
            .map(|name| catalogue.find(name).unwrap().manifest.dimension(DescriptorKind::GEM));
        assert_eq!(dimensions, [Some(384), Some(768), Some(1024)]);
    }

    #[test]
    fn urls_are_on_the_configured_hub() {
        let catalogue = Catalogue::built_in().unwrap();
        let large = catalogue.find("dinov2-large").unwrap();
        assert_eq!(
            large.url("https://mirror.example/hub/", &large.manifest.file),
            "https://mirror.example/hub/onnx-community/dinov2-large/resolve/main/onnx/model.onnx"
        );
        assert_eq!(
            large.url("https://mirror.example/hub", Path::new("model.onnx_data")),
            "https://mirror.example/hub/onnx-community/dinov2-large/resolve/main/onnx/model.onnx_data"
        );
    }

    #[test]
    fn manifests_round_trip_through_toml() {
        for entry in Catalogue::built_in().unwrap().entries() {
            let text = toml::to_string(&entry.manifest).unwrap();
            let read = Manifest::parse(&text, Path::new("manifest.toml")).unwrap();
            assert_eq!(format!("{read:?}"), format!("{:?}", entry.manifest));
        }
    }
}
