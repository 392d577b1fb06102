//! The backup archive: maps with their images, poses, descriptors and picture bytes in one tar file that is independent
//! of the store and the machine.
//!
//! ```text
//! manifest.json             format, version, and the list of maps
//! maps/NAME/map.json        the map, with the digest of the model that computed its descriptors
//! maps/NAME/vocabulary.bin  the vocabulary of the map's own, if map.json names one
//! maps/NAME/SHA256.json     an image record with its descriptor, named by the SHA-256 of this entry
//! maps/NAME/SHA256.jpg      the picture of that image, named by its SHA-256
//! maps/NAME/left-out.json   instead of an image that could not be saved: its id and the reason
//! …
//! end.json                  summary of the archive, and the SHA-256 of all bytes before this entry
//! ```
//!
//! Images are sorted by id. A file without `end.json` is incomplete: it can be resumed, but not restored. A reader
//! accepts exactly these entries in this order.

mod checkpoint;
mod read;
mod write;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

pub use self::checkpoint::Checkpoint;
pub use self::read::{Item, Reader};
pub use self::write::{Resumed, Writer, partial_path};
use whereabouts_core::{Digest, ImageId, MapName, MediaType};

/// Name of the format in `manifest.json`.
pub const FORMAT: &str = "whereabouts-backup";
/// Version of the format that is written.
pub const VERSION: u32 = 2;
/// Oldest version of the format that is read; it has no vocabularies.
pub const OLDEST_VERSION: u32 = 1;

const MANIFEST: &str = "manifest.json";
const END: &str = "end.json";
const BLOCK: usize = 512;

/// The first entry of an archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always [`FORMAT`].
    pub format: String,
    /// Format version; see [`VERSION`].
    pub version: u32,
    /// Version of the program that wrote the archive.
    pub made_by: String,
    /// When the backup was started.
    pub created_at: Timestamp,
    /// The maps that were requested, in the order of the archive.
    pub maps: Vec<MapName>,
}

impl Manifest {
    /// Creates the manifest of a backup that starts now.
    pub fn new(maps: Vec<MapName>) -> Self {
        Self {
            format: FORMAT.to_owned(),
            version: VERSION,
            made_by: env!("CARGO_PKG_VERSION").to_owned(),
            created_at: Timestamp::now(),
            maps,
        }
    }
}

/// The last entry of an archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct End {
    /// When the backup was complete.
    pub finished_at: Timestamp,
    /// Maps in the archive.
    pub maps: Vec<ArchivedMap>,
    /// Number of entries before this one.
    pub entries: u64,
    /// Number of bytes before this entry.
    pub bytes: u64,
    /// SHA-256 of the bytes before this entry.
    pub sha256: Digest,
}

/// Summary of a map in the archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArchivedMap {
    /// Name of the map.
    pub name: MapName,
    /// Number of images in the archive.
    pub images: usize,
    /// Images of the map that could not be saved.
    pub left_out: Vec<LeftOut>,
}

/// An image that could not be saved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Id of the image.
    pub id: ImageId,
    /// Why the image could not be saved.
    pub why: String,
}

/// Why an archive cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    /// A file operation failed.
    #[error("cannot {what}: {source}")]
    Disk {
        /// The operation.
        what: String,
        /// Cause.
        source: std::io::Error,
    },
    /// The archive is incomplete.
    #[error("the archive ends after {0} bytes: it was truncated, or its backup was not finished")]
    Truncated(u64),
    /// The bytes differ from those that were written.
    #[error("the archive is damaged at byte {at}: {why}")]
    Damaged {
        /// Position in the archive.
        at: u64,
        /// What is wrong.
        why: String,
    },
    /// The file is not a valid archive.
    #[error("this is not a backup that can be restored: {0}")]
    Refused(String),
}

fn record_name(map: &MapName, digest: &Digest) -> String {
    format!("maps/{map}/{}.json", digest.hex())
}

fn bytes_name(map: &MapName, digest: &Digest, media_type: MediaType) -> String {
    format!("maps/{map}/{}.{}", digest.hex(), media_type.extension())
}

fn left_out_name(map: &MapName) -> String {
    format!("maps/{map}/left-out.json")
}

fn vocabulary_name(map: &MapName) -> String {
    format!("maps/{map}/vocabulary.bin")
}

fn map_name(map: &MapName) -> String {
    format!("maps/{map}/map.json")
}

#[cfg(test)]
mod round_trip;
#[cfg(test)]
mod tests;
