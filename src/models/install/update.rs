//! The manifest of an installed model, and that of the catalogue: whether they agree, and how to adopt the latter.

use std::fs;
use std::path::{Path, PathBuf};

use super::{InstallError, ModelsFolder, disk, name_external, verify};
use crate::catalogue::Entry;
use crate::onnx::external_files;
use crate::partial::remove_if_there;
use whereabouts_vision::manifest::Input;
use whereabouts_vision::{Assets, Manifest};

/// What an installed model takes and gives otherwise than the catalogue's manifest says.
#[derive(Debug, Clone)]
pub struct Difference {
    /// The input of the installed manifest.
    pub installed: Input,
    /// The input of the catalogue's manifest.
    pub catalogue: Input,
}

/// The result of an update.
#[derive(Debug)]
pub enum Updated {
    /// The model is not installed.
    NotInstalled,
    /// The installed manifest makes the same descriptors as the catalogue's.
    Current(PathBuf),
    /// The manifest of the catalogue was installed.
    Replaced {
        /// Folder of the model.
        folder: PathBuf,
        /// What changed.
        difference: Difference,
        /// What works with restrictions.
        notes: Vec<String>,
    },
}

impl Difference {
    /// Compares an installed manifest with the catalogue's; `None` if both make the same descriptors of the same files.
    pub(super) fn of(installed: &Manifest, entry: &Entry) -> Option<Self> {
        let catalogue = &entry.manifest;
        let same_kind = |kind| installed.digest(&[], kind) == catalogue.digest(&[], kind);
        let is_same =
            installed.kinds() == catalogue.kinds() && installed.kinds().into_iter().all(same_kind);
        let difference =
            || Self { installed: installed.input.clone(), catalogue: catalogue.input.clone() };
        (!is_same).then(difference)
    }
}

impl ModelsFolder {
    /// Replaces the manifest of an installed model by that of the catalogue, if they make different descriptors. The
    /// files of the model are kept. It is tried before the manifest is replaced.
    pub fn update(&self, assets: &Assets, entry: &Entry) -> Result<Updated, InstallError> {
        let name = entry.name();
        let _lock = self.lock(name)?;
        let target = self.models.join(name);
        if !target.exists() {
            return Ok(Updated::NotInstalled);
        }
        let verified = verify(&target)?;
        let Some(difference) = Difference::of(&verified.manifest, entry) else {
            return Ok(Updated::Current(target));
        };
        let mut manifest = entry.manifest.clone();
        name_external(&mut manifest, &external_files(&target.join(&verified.manifest.file))?)?;
        let mut kept = Vec::new();
        // The same files in both: a catalogue's model has no vocabulary of its own.
        for ((from, _), (to, _)) in verified.manifest.files().zip(manifest.files()) {
            let copy = self.partial(name, to);
            remove_if_there(&copy).map_err(disk("remove", &copy))?;
            keep(&target.join(from), &copy)?;
            kept.push(copy);
        }
        manifest.pin(&verified.digests);
        let placed = self.place(assets, &manifest, entry.licence_note.as_deref());
        if placed.is_err() {
            for copy in kept {
                remove_if_there(&copy).map_err(disk("remove", &copy))?;
            }
        }
        let (folder, notes) = placed?;
        Ok(Updated::Replaced { folder, difference, notes })
    }
}

/// Gives a file a second name, or copies it where that is not possible.
fn keep(file: &Path, copy: &Path) -> Result<(), InstallError> {
    match fs::hard_link(file, copy) {
        Ok(()) => Ok(()),
        Err(_) => fs::copy(file, copy).map(drop).map_err(disk("copy the model to", copy)),
    }
}
