//! Writing an archive, or more of one that was interrupted.

use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::Serialize;
use sha2::{Digest as _, Sha256};
use tar::{EntryType, Header};

use super::read::{Item, Reader};
use super::{
    ArchiveError, ArchivedMap, BLOCK, END, End, LeftOut, MANIFEST, Manifest, bytes_name,
    left_out_name, map_name, record_name,
};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, ImageId, Map, MapName};

/// Writes an archive beside its place; it is there when it is whole.
pub struct Writer {
    file: BufWriter<File>,
    path: PathBuf,
    mark: Checkpoint,
    /// What entries say about when they were changed, in seconds since 1970.
    made_at: u64,
}

/// A place in the archive to which the writer can go back.
#[derive(Clone)]
pub struct Checkpoint {
    hash: Sha256,
    bytes: u64,
    entries: u64,
}

/// How far an interrupted backup had come.
#[derive(Default)]
pub struct Resumed {
    /// The maps that were begun, with their images so far; the last one may have more.
    pub maps: Vec<ArchivedMap>,
    /// The last map, as its server described it, and its last image.
    pub map: Option<Map>,
    /// See `map`.
    pub last: Option<ImageId>,
    /// Where the last map begins.
    pub begins: Option<Checkpoint>,
}

/// Where an archive grows until it is whole.
pub fn growing(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    path.with_file_name(name)
}

impl Writer {
    /// Begins an archive. What an interrupted backup left is overwritten.
    pub fn begin(path: &Path, manifest: &Manifest) -> Result<Self, ArchiveError> {
        let partial = growing(path);
        let file = File::create(&partial).map_err(disk("write", &partial))?;
        let mark = Checkpoint { hash: Sha256::new(), bytes: 0, entries: 0 };
        let (file, made_at) = (BufWriter::new(file), seconds(manifest));
        let mut writer = Self { file, path: path.to_owned(), mark, made_at };
        writer.json(MANIFEST, manifest)?;
        Ok(writer)
    }

    /// Goes on where an interrupted backup of the same maps left off; `None` if there is none.
    /// What it wrote last and did not finish is written anew.
    pub fn go_on(
        path: &Path,
        maps: &[MapName],
    ) -> Result<Option<(Self, Manifest, Resumed)>, ArchiveError> {
        let partial = growing(path);
        if !partial.is_file() {
            return Ok(None);
        }
        let mut reader = Reader::open(&partial)?;
        let Ok(Some(Item::Manifest(manifest))) = reader.next_item() else { return Ok(None) };
        if manifest.maps != maps {
            return Ok(None);
        }
        let (mut resumed, mut mark) = (Resumed::default(), reader.mark());
        // Whatever is wrong with the rest, up to there it is right.
        while let Ok(Some(item)) = reader.next_item() {
            match item {
                Item::Map(map) => {
                    (resumed.map, resumed.last) = (Some(map), None);
                    resumed.begins = Some(mark);
                }
                Item::Image(image, _) => resumed.last = Some(image.image.id),
                Item::LeftOut(left_out) => resumed.last = Some(left_out.id),
                Item::Manifest(_) | Item::End(_) => break,
            }
            mark = reader.mark();
            resumed.maps = reader.found().to_vec();
        }
        let file = File::options().write(true).open(&partial).map_err(disk("write", &partial))?;
        let (file, made_at) = (BufWriter::new(file), seconds(&manifest));
        let mut writer = Self { file, path: path.to_owned(), mark: mark.clone(), made_at };
        writer.go_back(&mark)?;
        Ok(Some((writer, manifest, resumed)))
    }

    /// The place that the archive has come to.
    pub fn mark(&self) -> Checkpoint {
        self.mark.clone()
    }

    /// Takes back what was written since.
    pub fn go_back(&mut self, mark: &Checkpoint) -> Result<(), ArchiveError> {
        let mut rewind = || {
            self.file.flush()?;
            self.file.get_ref().set_len(mark.bytes)?;
            self.file.seek(SeekFrom::Start(mark.bytes))
        };
        rewind().map_err(disk("write", &self.path))?;
        self.mark = mark.clone();
        Ok(())
    }

    /// Begins a map.
    pub fn map(&mut self, map: &Map) -> Result<(), ArchiveError> {
        self.json(&map_name(&map.name), map)
    }

    /// Adds an image to a map.
    pub fn image(
        &mut self,
        map: &MapName,
        image: &ExportedImage,
        bytes: &[u8],
    ) -> Result<(), ArchiveError> {
        let record = to_json(image)?;
        self.entry(&record_name(map, &Digest::of(&record)), &record)?;
        let digest = &image.image.digest;
        self.entry(&bytes_name(map, digest, image.image.media_type), bytes)
    }

    /// Says that an image of a map could not be saved.
    pub fn left_out(&mut self, map: &MapName, left_out: &LeftOut) -> Result<(), ArchiveError> {
        self.json(&left_out_name(map), left_out)
    }

    /// Ends the archive and puts it in its place, for good.
    pub fn finish(mut self, maps: Vec<ArchivedMap>) -> Result<End, ArchiveError> {
        let (sha256, bytes, entries) = self.mark.clone().of_whole();
        let end = End { finished_at: Timestamp::now(), maps, entries, bytes, sha256 };
        self.json(END, &end)?;
        let place = self.path.clone();
        let folder = match place.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        let mut done = || {
            self.file.write_all(&[0; 2 * BLOCK])?;
            self.file.flush()?;
            self.file.get_ref().sync_all()?;
            fs::rename(growing(&place), &place)?;
            File::open(folder)?.sync_all()
        };
        done().map_err(disk("write", &place))?;
        Ok(end)
    }

    fn json<T: Serialize>(&mut self, name: &str, value: &T) -> Result<(), ArchiveError> {
        let bytes = to_json(value)?;
        self.entry(name, &bytes)
    }

    fn entry(&mut self, name: &str, bytes: &[u8]) -> Result<(), ArchiveError> {
        let mut header = Header::new_ustar();
        header.set_entry_type(EntryType::Regular);
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_uid(0);
        header.set_gid(0);
        header.set_mtime(self.made_at);
        let named = header.set_path(name);
        header.set_cksum();
        let padding = bytes.len().next_multiple_of(BLOCK) - bytes.len();
        let written = named.and_then(|()| {
            self.write(header.as_bytes())?;
            self.write(bytes)?;
            self.write(&[0; BLOCK][..padding])
        });
        self.mark.entries += 1;
        written.map_err(disk("write", &growing(&self.path)))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.mark.take(bytes);
        Ok(())
    }
}

impl Checkpoint {
    pub(super) fn new(hash: Sha256, bytes: u64, entries: u64) -> Self {
        Self { hash, bytes, entries }
    }

    /// The SHA-256 of all bytes before it, how many they are, and of how many entries.
    pub(super) fn of_whole(self) -> (Digest, u64, u64) {
        (Digest::from(<[u8; 32]>::from(self.hash.finalize())), self.bytes, self.entries)
    }

    fn take(&mut self, bytes: &[u8]) {
        self.hash.update(bytes);
        self.bytes += bytes.len() as u64;
    }
}

fn seconds(manifest: &Manifest) -> u64 {
    manifest.created_at.as_second().try_into().unwrap_or(0)
}

fn to_json<T: Serialize>(value: &T) -> Result<Vec<u8>, ArchiveError> {
    serde_json::to_vec(value)
        .map_err(|error| ArchiveError::Disk { what: "write JSON".into(), source: error.into() })
}

pub(super) fn disk(what: &str, path: &Path) -> impl FnOnce(io::Error) -> ArchiveError + use<> {
    let what = format!("{what} {}", path.display());
    move |source| ArchiveError::Disk { what, source }
}
