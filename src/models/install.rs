//! The folder `ASSETS/models`: installing and verifying models.

mod error;
mod lock;
mod update;

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

pub use self::error::InstallError;
use self::lock::InstallLock;
pub use self::update::{Difference, Updated};
use super::catalogue::Entry;
use super::download::{Download, DownloadSettings, Progress};
use super::onnx::{ExternalFiles, external_files};
use super::partial::remove_if_there;
use whereabouts_core::Digest;
use whereabouts_vision::{AUTO, Assets, CHOSEN, DataFile, MANIFEST, Manifest};
use whereabouts_vision::{file_digest, try_model};

/// The `models` folder of a writable assets folder.
#[derive(Debug, Clone)]
pub struct ModelsFolder {
    models: PathBuf,
}

/// The result of a pull.
#[derive(Debug)]
pub enum Pulled {
    /// The model is already installed and intact.
    Present {
        /// Folder of the model.
        folder: PathBuf,
        /// What its manifest does otherwise than the catalogue's.
        difference: Option<Difference>,
    },
    /// The model was downloaded and installed.
    Installed {
        /// Folder of the model.
        folder: PathBuf,
        /// Digests of the model's files, the ONNX file first.
        digests: Vec<Digest>,
        /// Whether the catalogue pins the digests. If not, they are recorded in the installed manifest.
        pinned: bool,
        /// Why the previously installed model was replaced, if there was one.
        replaced: Option<String>,
        /// What works with restrictions.
        notes: Vec<String>,
    },
}

/// The result of adding a model file.
#[derive(Debug)]
pub enum Added {
    /// The same file is already installed under this name.
    Present(PathBuf),
    /// The file was copied and installed.
    Installed {
        /// Folder of the model.
        folder: PathBuf,
        /// Name of the model.
        name: String,
        /// Digests of the model's files, the ONNX file first.
        digests: Vec<Digest>,
        /// What works with restrictions.
        notes: Vec<String>,
    },
}

/// An installed model whose files match its manifest.
#[derive(Debug)]
pub struct VerifiedFiles {
    /// The installed manifest.
    pub manifest: Manifest,
    /// Digests of the model's files, the ONNX file first.
    pub digests: Vec<Digest>,
    /// Total size of the files in bytes.
    pub bytes: u64,
}

impl ModelsFolder {
    /// Opens or creates `models` in an assets folder, and checks that it is writable.
    pub fn open(assets: &Path) -> Result<Self, InstallError> {
        let models = assets.join("models");
        let partial = models.join(".partial");
        fs::create_dir_all(&partial).map_err(disk("make", &partial))?;
        let probe = partial.join("probe");
        File::create(&probe).map_err(disk("write", &probe))?;
        remove_if_there(&probe).map_err(disk("remove", &probe))?;
        Ok(Self { models })
    }

    /// Downloads a model of the catalogue from `hub`, unless it is installed and intact. It is tried before it is
    /// installed.
    pub async fn pull(
        &self,
        assets: &Assets,
        entry: &Entry,
        hub: &str,
        settings: DownloadSettings,
        mut on_progress: impl FnMut(Progress),
    ) -> Result<Pulled, InstallError> {
        let name = entry.name();
        let _lock = self.lock(name)?;
        let target = self.models.join(name);
        let replaced = match target.join(MANIFEST).exists() {
            false => None,
            true => match self.fault(&target, entry) {
                None => {
                    let installed = Manifest::read(&target.join(MANIFEST))?;
                    let difference = Difference::of(&installed, entry);
                    return Ok(Pulled::Present { folder: target, difference });
                }
                fault => fault,
            },
        };
        let mut manifest = entry.manifest.clone();
        let mut digests = Vec::new();
        let mut external = ExternalFiles::new();
        let mut next = 0;
        // The ONNX file says which others there are.
        let nth = |manifest: &Manifest, n| {
            manifest.files().nth(n).map(|(file, pinned)| (file.to_owned(), pinned))
        };
        while let Some((file, pinned)) = nth(&manifest, next) {
            let url = entry.url(hub, &file);
            let to = self.partial(name, &file);
            let download = Download { url: &url, to: &to, pinned, settings };
            digests.push(download.run(&mut on_progress).await?);
            let checked = match next {
                0 => external_files(&to).map_err(InstallError::from).and_then(|found| {
                    external = found;
                    name_external(&mut manifest, &external)
                }),
                _ => check_weights(&to, external.get(&file).copied().unwrap_or(0)),
            };
            if let Err(error) = checked {
                // Complete but wrong: it must not be resumed.
                remove_if_there(&to).map_err(disk("remove", &to))?;
                return Err(error);
            }
            next += 1;
        }
        let pinned = manifest.files().all(|(_, pinned)| pinned.is_some());
        manifest.pin(&digests);
        let (folder, notes) = self.place(assets, &manifest, entry.licence_note.as_deref())?;
        Ok(Pulled::Installed { folder, digests, pinned, replaced, notes })
    }

    /// Installs an ONNX file, its external weights and the manifest under `name`, or under the name in the
    /// manifest. The model is tried before it is installed. The digests are recorded in the installed manifest.
    pub fn add(
        &self,
        assets: &Assets,
        file: &Path,
        manifest: &Path,
        name: Option<&str>,
    ) -> Result<Added, InstallError> {
        let source = manifest;
        let mut manifest = Manifest::read(source)?;
        if let Some(name) = name {
            name.clone_into(&mut manifest.name);
        }
        let name = manifest.name.clone();
        let _lock = self.lock(&name)?;
        if file.is_dir() {
            return Err(InstallError::Folder(file.to_owned()));
        }
        let external = external_files(file)?;
        name_external(&mut manifest, &external)?;
        let mut given = vec![file.to_owned()];
        for data in &manifest.data {
            let path = file.with_file_name("").join(&data.file);
            check_weights(&path, external.get(&data.file).copied().unwrap_or(0))?;
            given.push(path);
        }
        // Written together with the manifest, not by the exporter of the weights.
        given.extend(
            manifest.vocabularies().map(|(vocabulary, _)| source.with_file_name(vocabulary)),
        );
        let mut digests = Vec::new();
        for (file, (_, pinned)) in given.iter().zip(manifest.files()) {
            let remedy = || format!("pass the file that {} describes", source.display());
            digests.push(checked(file, pinned, remedy)?.0);
        }
        let target = self.models.join(&name);
        if target.exists() {
            return match verify(&target) {
                Ok(verified) if verified.digests == digests => Ok(Added::Present(target)),
                _ => Err(InstallError::Taken(target)),
            };
        }
        let copies: Vec<PathBuf> =
            manifest.files().map(|(installed, _)| self.partial(&name, installed)).collect();
        let installed = copied(&given, &copies).and_then(|digests| {
            manifest.pin(&digests);
            let (folder, notes) = self.place(assets, &manifest, None)?;
            Ok(Added::Installed { folder, name, digests, notes })
        });
        if installed.is_err() {
            for copy in copies {
                remove_if_there(&copy).map_err(disk("remove", &copy))?;
            }
        }
        installed
    }

    /// Chooses the model that `auto` resolves to; `None` removes the choice.
    pub fn choose(&self, name: Option<&str>) -> Result<(), InstallError> {
        let chosen = self.models.join(CHOSEN);
        match name {
            None => remove_if_there(&chosen).map_err(disk("remove", &chosen)),
            Some(name) => {
                let temporary = self.partial("", Path::new(CHOSEN));
                write_durably(&temporary, &format!("{name}\n"))?;
                fs::rename(&temporary, &chosen).map_err(disk("write", &chosen))?;
                sync_folder(&self.models)
            }
        }
    }

    /// Why an installed model is to be replaced by a pull; `None` if it is intact.
    fn fault(&self, target: &Path, entry: &Entry) -> Option<String> {
        let verified = match verify(target) {
            Ok(verified) => verified,
            Err(error) => return Some(error.to_string()),
        };
        let mut pins = entry.manifest.files().zip(&verified.digests);
        pins.find_map(|((file, pinned), got)| {
            let pinned = pinned.filter(|pinned| pinned != got)?;
            Some(format!(
                "{} had the digest {got}, but the catalogue pins {pinned}",
                file.display()
            ))
        })
    }

    fn lock(&self, name: &str) -> Result<InstallLock, InstallError> {
        if !is_name(name) {
            return Err(InstallError::Name(name.to_owned()));
        }
        InstallLock::acquire(name, self.partial(name, Path::new("lock")))
    }

    fn partial(&self, name: &str, what: &Path) -> PathBuf {
        let what = what.display().to_string().replace(std::path::MAIN_SEPARATOR, "-");
        self.models.join(".partial").join(format!("{name}-{what}"))
    }

    /// Moves a model's finished files, which are already durable, and its manifest into place as one folder, if the
    /// model does what the manifest says. Returns the folder, and what works with restrictions.
    fn place(
        &self,
        assets: &Assets,
        manifest: &Manifest,
        licence_note: Option<&str>,
    ) -> Result<(PathBuf, Vec<String>), InstallError> {
        let staged = self.partial(&manifest.name, Path::new("new"));
        let old = self.partial(&manifest.name, Path::new("old"));
        let target = self.models.join(&manifest.name);
        remove_folder(&staged)?;
        remove_folder(&old)?;
        fs::create_dir(&staged).map_err(disk("make", &staged))?;
        write_durably(&staged.join(MANIFEST), &manifest.to_toml()?)?;
        if let Some(note) = licence_note {
            let text = format!("{}: {}\n\n{note}\n", manifest.name, manifest.licence);
            write_durably(&staged.join("LICENCE"), &text)?;
        }
        for (file, _) in manifest.files() {
            let (partial, to) = (self.partial(&manifest.name, file), staged.join(file));
            if let Some(folder) = to.parent() {
                fs::create_dir_all(folder).map_err(disk("make", folder))?;
            }
            fs::rename(&partial, &to).map_err(disk("move", &partial))?;
        }
        let notes = match try_model(assets, &staged) {
            Ok(notes) => notes,
            Err(fault) => {
                remove_folder(&staged)?;
                return Err(fault.into());
            }
        };
        for (file, _) in manifest.files() {
            staged.join(file).parent().map_or(Ok(()), sync_folder)?;
        }
        sync_folder(&staged)?;
        if target.exists() {
            fs::rename(&target, &old).map_err(disk("move", &target))?;
        }
        fs::rename(&staged, &target).map_err(disk("move the finished model to", &target))?;
        sync_folder(&self.models)?;
        remove_folder(&old)?;
        Ok((target, notes))
    }
}

/// Copies files durably, and returns the digests of the copies: the sources may have changed since they were checked.
fn copied(files: &[PathBuf], copies: &[PathBuf]) -> Result<Vec<Digest>, InstallError> {
    let copy = |(file, copy): (&PathBuf, &PathBuf)| {
        fs::copy(file, copy).map_err(disk("copy the model to", copy))?;
        let digest = digest_of(copy)?.0;
        File::open(copy).and_then(|file| file.sync_all()).map_err(disk("sync", copy))?;
        Ok(digest)
    };
    files.iter().zip(copies).map(copy).collect()
}

/// Adds the files of external weights that the manifest does not name yet.
fn name_external(manifest: &mut Manifest, external: &ExternalFiles) -> Result<(), InstallError> {
    for file in external.keys() {
        if !manifest.data.iter().any(|data| data.file == *file) {
            manifest.data.push(DataFile { file: file.clone(), sha256: None });
        }
    }
    Ok(manifest.check(Path::new(&manifest.name))?)
}

fn check_weights(file: &Path, needed: u64) -> Result<(), InstallError> {
    let bytes = fs::metadata(file).ok().filter(fs::Metadata::is_file).map(|found| found.len());
    match bytes {
        Some(bytes) if bytes >= needed => Ok(()),
        bytes => Err(InstallError::Weights { file: file.to_owned(), bytes, needed }),
    }
}

/// Hashes the files of an installed model and checks them against its manifest, without running the model.
pub fn verify(folder: &Path) -> Result<VerifiedFiles, InstallError> {
    let manifest = Manifest::read(&folder.join(MANIFEST))?;
    let (mut digests, mut bytes) = (Vec::new(), 0);
    for (file, pinned) in manifest.files() {
        let (digest, size) = checked(&folder.join(file), pinned, || "install it again".into())?;
        digests.push(digest);
        bytes += size;
    }
    let external = external_files(&folder.join(&manifest.file))?;
    let is_named = |file: &PathBuf| manifest.data.iter().any(|data| data.file == *file);
    if let Some(unnamed) = external.into_keys().find(|file| !is_named(file)) {
        return Err(InstallError::Unnamed(unnamed));
    }
    Ok(VerifiedFiles { manifest, digests, bytes })
}

/// Hashes a file and checks it against the pinned digest, if there is one. Returns the digest and the size.
fn checked(
    file: &Path,
    pinned: Option<Digest>,
    remedy: impl FnOnce() -> String,
) -> Result<(Digest, u64), InstallError> {
    let (got, bytes) = digest_of(file)?;
    match pinned {
        Some(pinned) if pinned != got => {
            let (file, remedy) = (file.to_owned(), remedy());
            Err(InstallError::Damaged { file, got, pinned, remedy })
        }
        _ => Ok((got, bytes)),
    }
}

fn is_name(name: &str) -> bool {
    let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    (1..=64).contains(&name.len())
        && name.bytes().all(is_allowed)
        && !name.starts_with('.')
        && ![AUTO, CHOSEN].contains(&name)
}

fn digest_of(path: &Path) -> Result<(Digest, u64), InstallError> {
    file_digest(path).map_err(disk("read", path))
}

fn write_durably(path: &Path, text: &str) -> Result<(), InstallError> {
    fs::write(path, text).and_then(|()| File::open(path)?.sync_all()).map_err(disk("write", path))
}

fn sync_folder(path: &Path) -> Result<(), InstallError> {
    File::open(path).and_then(|folder| folder.sync_all()).map_err(disk("sync", path))
}

fn remove_folder(path: &Path) -> Result<(), InstallError> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(disk("remove", path)(error)),
        _ => Ok(()),
    }
}

fn disk(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> InstallError {
    let path = path.to_owned();
    move |source| InstallError::Disk { doing, path, source }
}

#[cfg(test)]
mod tests;
