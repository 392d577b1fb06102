//! A partially downloaded file, and the metadata needed to resume it after a crash.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use whereabouts_core::Digest;

/// A partial file on disk, with the running digest of its bytes.
#[derive(Debug)]
pub(super) struct Partial {
    path: PathBuf,
    file: File,
    hasher: Sha256,
    length: u64,
    origin: Origin,
}

/// Where the bytes came from. Stored in a sidecar file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Origin {
    /// URL of the file.
    pub url: String,
    /// Strong entity tag, if the server sent one.
    pub etag: Option<String>,
    /// Total length of the file, if the server reported it.
    pub total: Option<u64>,
}

impl Partial {
    /// Opens a partial file and hashes the bytes in it. Truncates the file unless the bytes came from `url` and
    /// mixing two versions of the file would be detected, by an entity tag or by a pinned digest.
    pub fn open(path: &Path, url: &str, pinned: bool) -> io::Result<Self> {
        let origin = fs::read_to_string(sidecar(path))
            .ok()
            .and_then(|text| toml::from_str::<Origin>(&text).ok())
            .filter(|origin| origin.url == url && (pinned || origin.etag.is_some()));
        let mut file =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
        let mut hasher = Sha256::new();
        let mut length = 0;
        if origin.is_some() {
            let mut buffer = vec![0; 1 << 20];
            loop {
                match file.read(&mut buffer)? {
                    0 => break,
                    read => {
                        hasher.update(&buffer[..read]);
                        length += read as u64;
                    }
                }
            }
        } else {
            file.set_len(0)?;
        }
        let origin = origin.unwrap_or_default();
        Ok(Self { path: path.to_owned(), file, hasher, length, origin })
    }

    /// Discards the bytes and starts over with those of `origin`.
    pub fn restart(&mut self, origin: Origin) -> io::Result<()> {
        // Truncate before writing the origin, so that a crash cannot pair old bytes with a new origin.
        *self = Self::emptied(std::mem::take(&mut self.path), origin)?;
        let text = toml::to_string(&self.origin).map_err(io::Error::other)?;
        fs::write(sidecar(&self.path), text)
    }

    fn emptied(path: PathBuf, origin: Origin) -> io::Result<Self> {
        let file = File::create(&path)?;
        Ok(Self { path, file, hasher: Sha256::new(), length: 0, origin })
    }

    /// Appends bytes.
    pub fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.hasher.update(bytes);
        self.length += bytes.len() as u64;
        Ok(())
    }

    /// Number of bytes on disk.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Where the bytes came from.
    pub fn origin(&self) -> &Origin {
        &self.origin
    }

    /// Removes the file and its sidecar.
    pub fn discard(self) -> io::Result<()> {
        remove_if_there(&sidecar(&self.path))?;
        remove_if_there(&self.path)
    }

    /// Makes the file durable, removes the sidecar, and returns the digest.
    pub fn finish(self) -> io::Result<Digest> {
        self.file.sync_all()?;
        remove_if_there(&sidecar(&self.path))?;
        Ok(Digest::from(<[u8; 32]>::from(self.hasher.finalize())))
    }
}

fn sidecar(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".origin");
    name.into()
}

pub(super) fn remove_if_there(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn origin(etag: Option<&str>) -> Origin {
        Origin { url: "http://hub/a".into(), etag: etag.map(str::to_owned), total: Some(6) }
    }

    fn leave_partial(path: &Path, etag: Option<&str>) {
        let mut partial = Partial::open(path, "http://hub/a", false).unwrap();
        partial.restart(origin(etag)).unwrap();
        partial.append(b"abc").unwrap();
    }

    #[test]
    fn a_partial_file_is_resumed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("file");
        leave_partial(&path, Some("\"1\""));
        let mut partial = Partial::open(&path, "http://hub/a", false).unwrap();
        assert_eq!((partial.length(), partial.origin()), (3, &origin(Some("\"1\""))));
        partial.append(b"def").unwrap();
        assert_eq!(partial.finish().unwrap(), Digest::of(b"abcdef"));
        assert_eq!(fs::read(&path).unwrap(), b"abcdef");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_partial_file_is_discarded_if_versions_could_be_mixed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("file");
        for (etag, url, pinned, kept) in [
            (None, "http://hub/a", false, 0),
            (None, "http://hub/a", true, 3),
            (Some("\"1\""), "http://mirror/a", true, 0),
        ] {
            leave_partial(&path, etag);
            assert_eq!(Partial::open(&path, url, pinned).unwrap().length(), kept, "{etag:?} {url}");
        }
    }
}
