//! Writing an archive, and resuming one that was interrupted.

use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::Serialize;
use tar::{EntryType, Header};

use super::checkpoint::{Checkpoint, disk};
use super::read::{Item, Reader};
use super::{
    ArchiveError, ArchivedMap, BLOCK, END, End, LeftOut, MANIFEST, Manifest, bytes_name,
    left_out_name, map_name, record_name, vocabulary_name,
};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, ImageId, Map, MapName};

/// Writes an archive to a partial file, which is renamed to its final path once it is complete.
pub struct Writer {
    file: BufWriter<File>,
    path: PathBuf,
    position: Checkpoint,
    /// Modification time of all entries, in Unix seconds.
    made_at: u64,
}

/// The state of an interrupted backup.
#[derive(Default)]
pub struct Resumed {
    /// The maps that were started, with their images so far. The last map may be incomplete.
    pub maps: Vec<ArchivedMap>,
    /// The last map, as recorded in the archive.
    pub map: Option<Map>,
    /// The last image of that map.
    pub last: Option<ImageId>,
    /// Start of the last map.
    pub map_start: Option<Checkpoint>,
}

/// Path of the partial file of an archive.
pub fn partial_path(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    path.with_file_name(name)
}

impl Writer {
    /// Starts an archive. Overwrites the partial file of an interrupted backup.
    pub fn begin(path: &Path, manifest: &Manifest) -> Result<Self, ArchiveError> {
        let partial = partial_path(path);
        let file = File::create(&partial).map_err(disk("write", &partial))?;
        let position = Checkpoint::default();
        let (file, made_at) = (BufWriter::new(file), seconds(manifest));
        let mut writer = Self { file, path: path.to_owned(), position, made_at };
        writer.json(MANIFEST, manifest)?;
        Ok(writer)
    }

    /// Resumes an interrupted backup of the same maps, if there is one, after its last complete item.
    pub fn resume(
        path: &Path,
        maps: &[MapName],
    ) -> Result<Option<(Self, Manifest, Resumed)>, ArchiveError> {
        let partial = partial_path(path);
        if !partial.is_file() {
            return Ok(None);
        }
        let mut reader = Reader::open(&partial)?;
        let Ok(Some(Item::Manifest(manifest))) = reader.next_item() else { return Ok(None) };
        if manifest.maps != maps {
            return Ok(None);
        }
        let (mut resumed, mut checkpoint) = (Resumed::default(), reader.checkpoint());
        // Everything before the first damaged or incomplete item is kept.
        while let Ok(Some(item)) = reader.next_item() {
            match item {
                Item::Map(map, _) => {
                    (resumed.map, resumed.last) = (Some(map), None);
                    resumed.map_start = Some(checkpoint);
                }
                Item::Image(image, _) => resumed.last = Some(image.image.id),
                Item::LeftOut(left_out) => resumed.last = Some(left_out.id),
                Item::Manifest(_) | Item::End(_) => break,
            }
            checkpoint = reader.checkpoint();
            resumed.maps = reader.found().to_vec();
        }
        let file = File::options().write(true).open(&partial).map_err(disk("write", &partial))?;
        let (file, made_at) = (BufWriter::new(file), seconds(&manifest));
        let position = checkpoint.clone();
        let mut writer = Self { file, path: path.to_owned(), position, made_at };
        writer.rewind(&checkpoint)?;
        Ok(Some((writer, manifest, resumed)))
    }

    /// The current position in the archive.
    pub fn checkpoint(&self) -> Checkpoint {
        self.position.clone()
    }

    /// Discards everything that was written after the checkpoint.
    pub fn rewind(&mut self, checkpoint: &Checkpoint) -> Result<(), ArchiveError> {
        let mut truncate = || {
            self.file.flush()?;
            self.file.get_ref().set_len(checkpoint.bytes)?;
            self.file.seek(SeekFrom::Start(checkpoint.bytes))
        };
        truncate().map_err(disk("write", &self.path))?;
        self.position = checkpoint.clone();
        Ok(())
    }

    /// Starts a map.
    /// `vocabulary` is its own, if its record names one.
    pub fn map(&mut self, map: &Map, vocabulary: Option<&[u8]>) -> Result<(), ArchiveError> {
        self.json(&map_name(&map.name), map)?;
        match vocabulary {
            Some(bytes) => self.entry(&vocabulary_name(&map.name), bytes),
            None => Ok(()),
        }
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

    /// Records that an image of a map could not be saved.
    pub fn left_out(&mut self, map: &MapName, left_out: &LeftOut) -> Result<(), ArchiveError> {
        self.json(&left_out_name(map), left_out)
    }

    /// Completes the archive: makes it durable and renames it to its final path.
    pub fn finish(mut self, maps: Vec<ArchivedMap>) -> Result<End, ArchiveError> {
        let (sha256, bytes, entries) = self.position.clone().totals();
        let end = End { finished_at: Timestamp::now(), maps, entries, bytes, sha256 };
        self.json(END, &end)?;
        let path = self.path.clone();
        let folder = match path.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        let mut done = || {
            self.file.write_all(&[0; 2 * BLOCK])?;
            self.file.flush()?;
            self.file.get_ref().sync_all()?;
            fs::rename(partial_path(&path), &path)?;
            File::open(folder)?.sync_all()
        };
        done().map_err(disk("write", &path))?;
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
        self.position.entries += 1;
        written.map_err(disk("write", &partial_path(&self.path)))
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.position.advance(bytes);
        Ok(())
    }
}

fn seconds(manifest: &Manifest) -> u64 {
    manifest.created_at.as_second().try_into().unwrap_or(0)
}

fn to_json<T: Serialize>(value: &T) -> Result<Vec<u8>, ArchiveError> {
    serde_json::to_vec(value)
        .map_err(|error| ArchiveError::Disk { what: "write JSON".into(), source: error.into() })
}
