//! The backup archive: maps with their images, poses, descriptors and bytes in one tar file, which no
//! store and no machine is needed to read.
//!
//! ```text
//! manifest.json             format, version, which maps
//! maps/NAME/map.json        the map, with the identity of the model that made its descriptors
//! maps/NAME/SHA256.json     an image and its descriptor; named by the SHA-256 of these bytes
//! maps/NAME/SHA256.jpg      the bytes of that image; named by their SHA-256
//! maps/NAME/left-out.json   in the place of an image that could not be saved: which, and why
//! …
//! end.json                  what is in the archive, and the SHA-256 of all bytes before this entry
//! ```
//!
//! Images are in the order of their ids. A file without its end is not whole: it can be continued, but
//! not restored. A reader takes entries of these names in this order, and nothing else.

mod read;
mod write;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

pub use self::read::{Item, Reader};
pub use self::write::{Checkpoint, Resumed, Writer, growing};
use whereabouts_core::{Digest, ImageId, MapName, MediaType};

/// What `manifest.json` calls the format.
pub const FORMAT: &str = "whereabouts-backup";
/// The version of the format that this program writes and reads.
pub const VERSION: u32 = 1;

const MANIFEST: &str = "manifest.json";
const END: &str = "end.json";
const BLOCK: usize = 512;

/// The first entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT`].
    pub format: String,
    /// [`VERSION`].
    pub version: u32,
    /// The version of the program that wrote it.
    pub made_by: String,
    /// When the backup was begun.
    pub created_at: Timestamp,
    /// The maps that were asked for, in the order of the archive.
    pub maps: Vec<MapName>,
}

impl Manifest {
    /// The manifest of a backup that begins now.
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

/// The last entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct End {
    /// When the backup was complete.
    pub finished_at: Timestamp,
    /// The maps in it.
    pub maps: Vec<ArchivedMap>,
    /// Entries before this one.
    pub entries: u64,
    /// Bytes before this entry, and their SHA-256.
    pub bytes: u64,
    /// See `bytes`.
    pub sha256: Digest,
}

/// A map in the archive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArchivedMap {
    /// Its name.
    pub name: MapName,
    /// Its images in the archive.
    pub images: usize,
    /// Images that were in the map and could not be saved.
    pub left_out: Vec<LeftOut>,
}

/// An image that could not be saved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Its id.
    pub id: ImageId,
    /// Why not.
    pub why: String,
}

/// Why an archive cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    /// The disk failed.
    #[error("cannot {what}: {source}")]
    Disk {
        /// What could not be done.
        what: String,
        /// Why not.
        source: std::io::Error,
    },
    /// It ends too early.
    #[error(
        "the archive breaks off after {0} bytes: it was cut short, or its backup has not ended"
    )]
    Truncated(u64),
    /// Its bytes are not those that were written.
    #[error("the archive is damaged at byte {at}: {why}")]
    Damaged {
        /// Where.
        at: u64,
        /// What is wrong.
        why: String,
    },
    /// It is not an archive of this kind.
    #[error("this is not a backup that can be restored: {0}")]
    Refused(String),
}

fn record_name(map: &MapName, digest: &Digest) -> String {
    format!("maps/{map}/{}.json", digest.hex())
}

fn bytes_name(map: &MapName, digest: &Digest, media_type: MediaType) -> String {
    let extension = match media_type {
        MediaType::Jpeg => "jpg",
        MediaType::Png => "png",
        MediaType::Webp => "webp",
    };
    format!("maps/{map}/{}.{extension}", digest.hex())
}

fn left_out_name(map: &MapName) -> String {
    format!("maps/{map}/left-out.json")
}

fn map_name(map: &MapName) -> String {
    format!("maps/{map}/map.json")
}

#[cfg(test)]
mod tests;
