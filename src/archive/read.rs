//! Reading an archive. The input is untrusted: any deviation from the format is an error.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

use bytes::Bytes;
use serde::de::DeserializeOwned;
use sha2::{Digest as _, Sha256};
use tar::{EntryType, Header};

use super::checkpoint::{Checkpoint, disk};
use super::{
    ArchiveError, ArchivedMap, BLOCK, END, End, FORMAT, LeftOut, MANIFEST, Manifest,
    OLDEST_VERSION, VERSION, bytes_name, left_out_name, map_name, record_name, vocabulary_name,
};
use whereabouts_core::ExportedImage;
use whereabouts_core::{Digest, ImageId, Map, MapName};

/// Maximum size of a JSON entry in bytes. `end.json` lists all images that were left out.
const MAX_JSON_BYTES: u64 = 64 << 20;
/// Maximum size of a picture in bytes.
const MAX_PICTURE_BYTES: u64 = 1 << 30;
/// Maximum initial allocation for an entry; more is allocated as bytes arrive, because sizes are untrusted.
const INITIAL_BYTES: usize = 1 << 20;

/// Reads an archive sequentially, one item at a time.
pub struct Reader<R = BufReader<File>> {
    file: R,
    hash: Sha256,
    bytes: u64,
    entries: u64,
    maps: Vec<MapName>,
    /// Maps read so far.
    found: Vec<ArchivedMap>,
    /// The map whose images are being read, and the id of the last image.
    current: Option<(Map, Option<ImageId>)>,
    state: State,
}

#[derive(PartialEq)]
enum State {
    Fresh,
    Open,
    Ended,
}

/// A verified part of an archive.
#[derive(Debug)]
pub enum Item {
    /// The first item.
    Manifest(Manifest),
    /// A map, with the vocabulary that it has of its own; its images follow.
    Map(Map, Option<Bytes>),
    /// An image and the bytes of its picture.
    Image(ExportedImage, Bytes),
    /// An image of the map that could not be saved.
    LeftOut(LeftOut),
    /// The last item: the archive is complete and undamaged.
    End(End),
}

struct Entry {
    name: String,
    bytes: Vec<u8>,
}

impl Reader {
    /// Opens an archive file.
    pub fn open(path: &Path) -> Result<Self, ArchiveError> {
        let file = File::open(path).map_err(disk("read", path))?;
        Ok(Self::new(BufReader::with_capacity(1 << 17, file)))
    }
}

impl<R: Read> Reader<R> {
    /// Reads an archive from any source.
    pub fn new(file: R) -> Self {
        Self {
            file,
            hash: Sha256::new(),
            bytes: 0,
            entries: 0,
            maps: Vec::new(),
            found: Vec::new(),
            current: None,
            state: State::Fresh,
        }
    }

    /// Number of bytes read so far.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Maps read so far, with their counts so far.
    pub(super) fn found(&self) -> &[ArchivedMap] {
        &self.found
    }

    /// The position after the last item.
    pub(super) fn checkpoint(&self) -> Checkpoint {
        Checkpoint::new(self.hash.clone(), self.bytes, self.entries)
    }

    /// Reads the next item; `None` after the end.
    pub fn next_item(&mut self) -> Result<Option<Item>, ArchiveError> {
        match self.state {
            State::Ended => Ok(None),
            State::Fresh => self.manifest().map(Some),
            State::Open => self.next_of_open().map(Some),
        }
    }

    fn manifest(&mut self) -> Result<Item, ArchiveError> {
        let refuse = |why: &str| Err(ArchiveError::Refused(why.to_owned()));
        let entry = match self.entry() {
            Ok(Some(entry)) if entry.name == MANIFEST => entry,
            Err(error @ ArchiveError::Disk { .. }) => return Err(error),
            _ => {
                return refuse(
                    "it does not begin with manifest.json; `whereabouts backup` makes one",
                );
            }
        };
        let manifest: Manifest = self.json(&entry)?;
        if manifest.format != FORMAT {
            return refuse("its manifest names another format");
        }
        if !(OLDEST_VERSION..=VERSION).contains(&manifest.version) {
            return refuse(&format!(
                "it has version {}, but this program reads versions {OLDEST_VERSION} to {VERSION}; restore it with \
                 the version of whereabouts that made it ({}), or a later one",
                manifest.version, manifest.made_by
            ));
        }
        self.maps.clone_from(&manifest.maps);
        self.state = State::Open;
        Ok(Item::Manifest(manifest))
    }

    fn next_of_open(&mut self) -> Result<Item, ArchiveError> {
        let before = self.checkpoint();
        let Some(entry) = self.entry()? else {
            return Err(ArchiveError::Truncated(self.bytes));
        };
        if entry.name == END {
            return self.end(&entry, before);
        }
        if let Some(name) = self.map_starting_with(&entry.name) {
            return self.map(name, &entry);
        }
        match self.current.take() {
            Some((map, last)) if entry.name == left_out_name(&map.name) => {
                self.left_out(map, last, &entry)
            }
            Some((map, last)) => self.image(map, last, &entry),
            None => Err(self.misplaced(&entry.name)),
        }
    }

    /// The requested map that starts with the entry `entry`, if it has not been read yet.
    fn map_starting_with(&self, entry: &str) -> Option<MapName> {
        let last = self.found.last().map(|last| &last.name);
        let position = last.and_then(|last| self.maps.iter().position(|map| map == last));
        let rest = &self.maps[position.map_or(0, |position| position + 1)..];
        rest.iter().find(|map| map_name(map) == entry).cloned()
    }

    fn map(&mut self, name: MapName, entry: &Entry) -> Result<Item, ArchiveError> {
        let map: Map = self.json(entry)?;
        if map.name != name {
            return Err(self.damaged("a map is stored under the name of another"));
        }
        let vocabulary = self.vocabulary(&map)?;
        self.found.push(ArchivedMap { name, images: 0, left_out: Vec::new() });
        self.current = Some((map.clone(), None));
        Ok(Item::Map(map, vocabulary))
    }

    fn vocabulary(&mut self, map: &Map) -> Result<Option<Bytes>, ArchiveError> {
        let Some(own) = &map.vocabulary else { return Ok(None) };
        match self.entry()? {
            None => Err(ArchiveError::Truncated(self.bytes)),
            Some(entry) if entry.name != vocabulary_name(&map.name) => {
                Err(self.misplaced(&entry.name))
            }
            Some(entry) if Digest::of(&entry.bytes) != own.digest => {
                Err(self.damaged("a vocabulary does not match its digest"))
            }
            Some(entry) => Ok(Some(entry.bytes.into())),
        }
    }

    fn left_out(
        &mut self,
        map: Map,
        last: Option<ImageId>,
        entry: &Entry,
    ) -> Result<Item, ArchiveError> {
        let left_out: LeftOut = self.json(entry)?;
        if last.is_some_and(|last| last >= left_out.id) {
            return Err(self.damaged("an image is out of order"));
        }
        if let Some(found) = self.found.last_mut() {
            found.left_out.push(left_out.clone());
        }
        self.current = Some((map, Some(left_out.id.clone())));
        Ok(Item::LeftOut(left_out))
    }

    fn image(
        &mut self,
        map: Map,
        last: Option<ImageId>,
        entry: &Entry,
    ) -> Result<Item, ArchiveError> {
        if !entry.name.ends_with(".json") {
            return Err(self.misplaced(&entry.name));
        }
        if entry.name != record_name(&map.name, &Digest::of(&entry.bytes)) {
            return Err(self.wrong_checksum(&entry.name));
        }
        let image: ExportedImage = self.json(entry)?;
        if last.is_some_and(|last| last >= image.image.id) {
            return Err(self.damaged("an image is out of order"));
        }
        if image.descriptor.as_ref().is_some_and(|descriptor| descriptor.dim() != map.dim) {
            return Err(self.damaged("a descriptor does not fit its map"));
        }
        let Some(bytes) = self.entry()? else { return Err(ArchiveError::Truncated(self.bytes)) };
        if bytes.name != bytes_name(&map.name, &image.image.digest, image.image.media_type) {
            return Err(self.misplaced(&bytes.name));
        }
        if Digest::of(&bytes.bytes) != image.image.digest {
            return Err(self.wrong_checksum(&bytes.name));
        }
        if let Some(found) = self.found.last_mut() {
            found.images += 1;
        }
        self.current = Some((map, Some(image.image.id.clone())));
        Ok(Item::Image(image, bytes.bytes.into()))
    }

    fn end(&mut self, entry: &Entry, before: Checkpoint) -> Result<Item, ArchiveError> {
        let end: End = self.json(entry)?;
        if (end.sha256, end.bytes, end.entries) != before.totals() {
            return Err(self.damaged("the checksum of the whole archive is wrong"));
        }
        if end.maps != self.found {
            return Err(self.damaged("its contents differ from the summary in end.json"));
        }
        let mut rest = Vec::new();
        let read = (&mut self.file).take(2 * BLOCK as u64 + 1).read_to_end(&mut rest);
        read.map_err(failed)?;
        if rest.len() < 2 * BLOCK {
            return Err(ArchiveError::Truncated(self.bytes + rest.len() as u64));
        }
        if rest != [0; 2 * BLOCK] {
            return Err(self.damaged("there is data after the end"));
        }
        self.state = State::Ended;
        Ok(Item::End(end))
    }

    /// Reads the next entry; `None` at the end of the tar file.
    fn entry(&mut self) -> Result<Option<Entry>, ArchiveError> {
        let block = self.take(BLOCK)?;
        if block.iter().all(|byte| *byte == 0) {
            return Ok(None);
        }
        let header = Header::from_byte_slice(&block);
        // The checksum is the sum of the header's bytes, with its own field counted as spaces.
        let sum = |bytes: &[u8]| bytes.iter().map(|byte| u32::from(*byte)).sum::<u32>();
        let expected = sum(&block[..148]) + 8 * u32::from(b' ') + sum(&block[156..]);
        if header.cksum().ok() != Some(expected) {
            return Err(self.damaged("the checksum of a header is wrong"));
        }
        if header.entry_type() != EntryType::Regular {
            return Err(ArchiveError::Refused(
                "it contains an entry that is not a regular file".into(),
            ));
        }
        let name = String::from_utf8(header.path_bytes().into_owned())
            .map_err(|_| self.damaged("a name is not UTF-8"))?;
        let max = if name.ends_with(".json") { MAX_JSON_BYTES } else { MAX_PICTURE_BYTES };
        let size = header.entry_size().map_err(|_| self.damaged("a size is not a number"))?;
        if size > max {
            return Err(ArchiveError::Refused(format!("its entry {name:?} has {size} bytes")));
        }
        let bytes = self.take(size as usize)?;
        let padding = bytes.len().next_multiple_of(BLOCK) - bytes.len();
        if self.take(padding)?.iter().any(|byte| *byte != 0) {
            return Err(self.damaged("the padding between two entries is not zero"));
        }
        self.entries += 1;
        Ok(Some(Entry { name, bytes }))
    }

    fn take(&mut self, length: usize) -> Result<Vec<u8>, ArchiveError> {
        let mut bytes = Vec::with_capacity(length.min(INITIAL_BYTES));
        (&mut self.file).take(length as u64).read_to_end(&mut bytes).map_err(failed)?;
        self.hash.update(&bytes);
        self.bytes += bytes.len() as u64;
        if bytes.len() < length {
            return Err(ArchiveError::Truncated(self.bytes));
        }
        Ok(bytes)
    }

    fn json<T: DeserializeOwned>(&self, entry: &Entry) -> Result<T, ArchiveError> {
        serde_json::from_slice(&entry.bytes)
            .map_err(|error| self.damaged(&format!("{:?} cannot be read: {error}", entry.name)))
    }

    fn damaged(&self, why: &str) -> ArchiveError {
        ArchiveError::Damaged { at: self.bytes, why: why.to_owned() }
    }

    fn wrong_checksum(&self, name: &str) -> ArchiveError {
        self.damaged(&format!("the checksum of {name:?} is wrong"))
    }

    fn misplaced(&self, name: &str) -> ArchiveError {
        let name: String = name.chars().take(200).collect();
        self.damaged(&format!("the entry {name:?} is not expected here"))
    }
}

fn failed(source: io::Error) -> ArchiveError {
    ArchiveError::Disk { what: "read the archive".into(), source }
}
