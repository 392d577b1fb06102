//! The folder `ASSETS/models`: putting models there, and checking those that are there.

use std::fs::{self, File, TryLockError};
use std::io;
use std::iter;
use std::path::{Path, PathBuf};

use super::catalogue::Entry;
use super::download::{Download, DownloadError, DownloadSettings, Progress};
use super::partial::remove_if_there;
use whereabouts_core::Digest;
use whereabouts_vision::{AUTO, CHOSEN, MANIFEST, Manifest, ManifestError, file_digest};

/// `ASSETS/models` of an assets folder that can be written.
#[derive(Debug, Clone)]
pub struct ModelsFolder {
    models: PathBuf,
}

/// What came of a pull.
#[derive(Debug)]
pub enum Pulled {
    /// The model was there and is whole.
    Present(PathBuf),
    /// It was downloaded.
    Installed {
        /// Its folder.
        folder: PathBuf,
        /// The digests of its files, the ONNX file first.
        digests: Vec<Digest>,
        /// Whether the catalogue pins them; if not, they are recorded in the manifest.
        pinned: bool,
        /// What was wrong with the model that was there before, if one was.
        replaced: Option<String>,
    },
}

/// What came of adding a file.
#[derive(Debug)]
pub enum Added {
    /// The same file is installed under this name.
    Present(PathBuf),
    /// It was copied.
    Installed {
        /// The model's folder.
        folder: PathBuf,
        /// The model's name.
        name: String,
        /// The digests of its files, the ONNX file first.
        digests: Vec<Digest>,
    },
}

/// What was found when an installed model was hashed again.
#[derive(Debug)]
pub struct Verdict {
    /// What its manifest says.
    pub manifest: Manifest,
    /// The digests of its files, the ONNX file first.
    pub digests: Vec<Digest>,
    /// The size of its files together.
    pub bytes: u64,
}

/// Why a model was not installed, or is not as it should be.
#[derive(Debug, thiserror::Error)]
pub enum InstallError {
    /// A name that cannot be a folder's.
    #[error(
        "{0:?} cannot be a model's name: use up to 64 letters, digits, '-', '_' and '.', not \
         beginning with '.', and neither \"auto\" nor \"chosen\""
    )]
    Name(String),
    /// Another process installs this model.
    #[error("another process is installing {name} ({lock} is locked); wait until it has ended")]
    Locked {
        /// The model.
        name: String,
        /// The lock.
        lock: PathBuf,
    },
    /// Another model has the name.
    #[error(
        "another model is installed in {0}; give this one another name with --name, or remove \
         that folder"
    )]
    Taken(PathBuf),
    /// The file is not the one that the manifest pins.
    #[error("{file} is {got}, but its manifest pins {pinned}; {remedy}")]
    Damaged {
        /// The model file.
        file: PathBuf,
        /// What it is.
        got: Digest,
        /// What it should be.
        pinned: Digest,
        /// What to do.
        remedy: String,
    },
    /// The manifest is wrong.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The download failed.
    #[error(transparent)]
    Download(#[from] DownloadError),
    /// The disk.
    #[error("cannot {doing} {path}: {source}")]
    Disk {
        /// What was tried.
        doing: &'static str,
        /// With what.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl ModelsFolder {
    /// Makes `models` in an assets folder if it is not there, and checks that it can be written.
    pub fn open(assets: &Path) -> Result<Self, InstallError> {
        let models = assets.join("models");
        let partial = models.join(".partial");
        fs::create_dir_all(&partial).map_err(disk("make", &partial))?;
        let probe = partial.join("probe");
        File::create(&probe).map_err(disk("write", &probe))?;
        Ok(Self { models })
    }

    /// Downloads a model of the catalogue from `hub`, unless it is there and whole.
    pub async fn pull(
        &self,
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
                None => return Ok(Pulled::Present(target)),
                fault => fault,
            },
        };
        let mut manifest = entry.manifest.clone();
        let mut digests = Vec::new();
        for (file, pinned) in entry.manifest.files() {
            let url = entry.address(hub, file);
            let to = self.partial(name, &file.display());
            let download = Download { url: &url, to: &to, pinned, settings };
            digests.push(download.run(&mut on_progress).await?);
        }
        let pinned = manifest.files().all(|(_, pinned)| pinned.is_some());
        manifest.pin(&digests);
        let folder = self.place(&manifest, entry.licence_note.as_deref())?;
        Ok(Pulled::Installed { folder, digests, pinned, replaced })
    }

    /// Copies an ONNX file, the file of weights beside it where the manifest names one, and the manifest
    /// under `name`, or the name in the manifest. The digests are recorded in the installed manifest.
    pub fn add(
        &self,
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
        let data = manifest.data.as_ref().map(|data| file.with_file_name(&data.file));
        let given: Vec<PathBuf> = iter::once(file.to_owned()).chain(data).collect();
        let mut digests = Vec::new();
        for (file, (_, pinned)) in given.iter().zip(manifest.files()) {
            let remedy = || format!("give the file that {} is for", source.display());
            digests.push(checked(file, pinned, remedy)?.0);
        }
        let target = self.models.join(&name);
        if target.exists() {
            return match verify(&target) {
                Ok(verdict) if verdict.digests == digests => Ok(Added::Present(target)),
                _ => Err(InstallError::Taken(target)),
            };
        }
        digests.clear();
        for (file, (installed, _)) in given.iter().zip(manifest.files()) {
            let copy = self.partial(&name, &installed.display());
            fs::copy(file, &copy).map_err(disk("copy the model to", &copy))?;
            // What was copied is what was hashed, or the file changed in between.
            digests.push(digest_of(&copy)?.0);
            File::open(&copy).and_then(|file| file.sync_all()).map_err(disk("sync", &copy))?;
        }
        manifest.pin(&digests);
        let folder = self.place(&manifest, None)?;
        Ok(Added::Installed { folder, name, digests })
    }

    /// Chooses the model that `auto` stands for; `None` leaves it to the order of preference.
    pub fn choose(&self, name: Option<&str>) -> Result<(), InstallError> {
        let chosen = self.models.join(CHOSEN);
        match name {
            None => remove_if_there(&chosen).map_err(disk("remove", &chosen)),
            Some(name) => {
                let beside = self.partial("", &CHOSEN);
                write_durably(&beside, &format!("{name}\n"))?;
                fs::rename(&beside, &chosen).map_err(disk("write", &chosen))?;
                sync_folder(&self.models)
            }
        }
    }

    /// What is wrong with an installed model, if anything: a pull replaces it then.
    fn fault(&self, target: &Path, entry: &Entry) -> Option<String> {
        let verdict = match verify(target) {
            Ok(verdict) => verdict,
            Err(error) => return Some(error.to_string()),
        };
        let mut pins = entry.manifest.files().zip(&verdict.digests);
        pins.find_map(|((file, pinned), was)| {
            let pinned = pinned.filter(|pinned| pinned != was)?;
            Some(format!("{} was {was}, but the catalogue pins {pinned}", file.display()))
        })
    }

    fn lock(&self, name: &str) -> Result<File, InstallError> {
        if !is_name(name) {
            return Err(InstallError::Name(name.to_owned()));
        }
        let path = self.partial(name, &"lock");
        let file = File::create(&path).map_err(disk("write", &path))?;
        match file.try_lock() {
            Ok(()) => Ok(file),
            Err(TryLockError::WouldBlock) => {
                Err(InstallError::Locked { name: name.to_owned(), lock: path })
            }
            Err(TryLockError::Error(source)) => {
                Err(InstallError::Disk { doing: "lock", path, source })
            }
        }
    }

    fn partial(&self, name: &str, what: &dyn std::fmt::Display) -> PathBuf {
        self.models.join(".partial").join(format!("{name}-{what}"))
    }

    /// Puts a model's finished partial files, which are durable, and its manifest in place as one
    /// folder.
    fn place(
        &self,
        manifest: &Manifest,
        licence_note: Option<&str>,
    ) -> Result<PathBuf, InstallError> {
        let staged = self.partial(&manifest.name, &"new");
        let old = self.partial(&manifest.name, &"old");
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
            let partial = self.partial(&manifest.name, &file.display());
            fs::rename(&partial, staged.join(file)).map_err(disk("move", &partial))?;
        }
        sync_folder(&staged)?;
        if target.exists() {
            fs::rename(&target, &old).map_err(disk("move", &target))?;
        }
        fs::rename(&staged, &target).map_err(disk("move the finished model to", &target))?;
        sync_folder(&self.models)?;
        remove_folder(&old)?;
        Ok(target)
    }
}

/// Hashes the files of an installed model and compares them with the manifest.
pub fn verify(folder: &Path) -> Result<Verdict, InstallError> {
    let manifest = Manifest::read(&folder.join(MANIFEST))?;
    let (mut digests, mut bytes) = (Vec::new(), 0);
    for (file, pinned) in manifest.files() {
        let (digest, size) = checked(&folder.join(file), pinned, || "install it again".into())?;
        digests.push(digest);
        bytes += size;
    }
    Ok(Verdict { manifest, digests, bytes })
}

/// The digest and the size of a file, which is the one that is pinned, if one is.
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
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    (1..=64).contains(&name.len())
        && name.bytes().all(plain)
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
mod tests {
    use super::*;
    use whereabouts_vision::Assets;

    fn fixture(file: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../tests/fixtures/models/tiny-tokens")
            .join(file)
    }

    #[test]
    fn a_file_that_is_added_is_pinned_and_found() {
        let assets = tempfile::tempdir().unwrap();
        let folder = ModelsFolder::open(assets.path()).unwrap();
        let add = |name| folder.add(&fixture("model.onnx"), &fixture(MANIFEST), name);
        let Added::Installed { folder: placed, digests, .. } = add(Some("mine")).unwrap() else {
            panic!("it was not there before");
        };
        let verdict = verify(&placed).unwrap();
        assert_eq!(verdict.digests, digests);
        assert_eq!(verdict.manifest.sha256, digests.first().copied());
        assert_eq!(verdict.manifest.name, "mine");
        assert_eq!(Assets::locate(Some(assets.path())).model("mine").unwrap(), placed);
        assert!(matches!(add(Some("mine")).unwrap(), Added::Present(_)));
        assert!(matches!(add(Some("../mine")), Err(InstallError::Name(_))));
        assert!(matches!(add(Some("auto")), Err(InstallError::Name(_))));
    }

    #[test]
    fn a_name_that_is_taken_and_a_wrong_file_are_refused() {
        let assets = tempfile::tempdir().unwrap();
        let folder = ModelsFolder::open(assets.path()).unwrap();
        folder.add(&fixture("model.onnx"), &fixture(MANIFEST), None).unwrap();
        let other = assets.path().join("other.onnx");
        fs::write(&other, "other").unwrap();
        let wrong = folder.add(&other, &fixture(MANIFEST), None).unwrap_err().to_string();
        assert!(wrong.contains("pins"), "{wrong}");
        let manifest = assets.path().join("other.toml");
        let text = fs::read_to_string(fixture(MANIFEST)).unwrap();
        let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
        fs::write(&manifest, unpinned.join("\n")).unwrap();
        assert!(matches!(folder.add(&other, &manifest, None), Err(InstallError::Taken(_))));
    }

    #[test]
    fn weights_in_a_file_of_their_own_are_added_and_checked() {
        let (assets, given) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let folder = ModelsFolder::open(assets.path()).unwrap();
        let (file, manifest) = (given.path().join("model.onnx"), given.path().join("given.toml"));
        fs::copy(fixture("model.onnx"), &file).unwrap();
        let text = fs::read_to_string(fixture(MANIFEST)).unwrap();
        let data = "[data]\nfile = \"model.onnx.data\"\n[input]";
        fs::write(&manifest, text.replace("[input]", data)).unwrap();
        let missing = folder.add(&file, &manifest, None).unwrap_err().to_string();
        assert!(missing.contains("model.onnx.data"), "{missing}");

        fs::write(given.path().join("model.onnx.data"), "weights").unwrap();
        let Added::Installed { folder: placed, digests, .. } =
            folder.add(&file, &manifest, None).unwrap()
        else {
            panic!("it was not there before");
        };
        assert_eq!(digests[1], Digest::of(b"weights"));
        assert_eq!(verify(&placed).unwrap().digests, digests);
        fs::write(placed.join("model.onnx.data"), "weight5").unwrap();
        assert!(matches!(verify(&placed), Err(InstallError::Damaged { .. })));
        fs::write(given.path().join("model.onnx.data"), "others").unwrap();
        assert!(matches!(folder.add(&file, &manifest, None), Err(InstallError::Taken(_))));
    }

    #[test]
    fn two_cannot_install_one_model_at_once() {
        let assets = tempfile::tempdir().unwrap();
        let folder = ModelsFolder::open(assets.path()).unwrap();
        let held = folder.lock("m").unwrap();
        assert!(matches!(folder.lock("m"), Err(InstallError::Locked { .. })));
        assert!(folder.lock("n").is_ok());
        drop(held);
        assert!(folder.lock("m").is_ok());
    }
}
