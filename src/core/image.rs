//! Reference images: pictures of a map with the poses they were taken from.

use std::collections::HashMap;
use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use super::{Descriptor, Digest, ImageTexts, InvalidName, Pose};

/// The id of an image within its map: 1 to 200 bytes of printable text.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "String", into = "String")]
pub struct ImageId(String);

impl ImageId {
    /// The longest id, in bytes of UTF-8.
    pub const MAX_BYTES: usize = 200;

    /// Derives the id of an image that was uploaded without one: the first 16 digits of its digest, so
    /// that uploading the same bytes again yields the same image.
    pub fn from_digest(digest: &Digest) -> Self {
        Self(digest.hex()[..16].to_owned())
    }

    /// The id as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for ImageId {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        let refuse = |why: &str| {
            let shown: String = text.chars().take(80).collect();
            Err(InvalidName(format!("image id {shown:?} {why}")))
        };
        if text.is_empty() || text.len() > Self::MAX_BYTES {
            return refuse("must have 1 to 200 bytes");
        }
        if text.chars().any(char::is_control) || text.trim() != text {
            return refuse("must not contain control characters or begin or end with a space");
        }
        // HTTP clients normalise such path segments away, so the image could not be addressed.
        if text == "." || text == ".." {
            return refuse("cannot be addressed in a URL");
        }
        Ok(Self(text.to_owned()))
    }
}

impl TryFrom<String> for ImageId {
    type Error = InvalidName;

    fn try_from(text: String) -> Result<Self, InvalidName> {
        text.parse()
    }
}

impl From<ImageId> for String {
    fn from(id: ImageId) -> Self {
        id.0
    }
}

impl fmt::Display for ImageId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A picture format that the service reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub enum MediaType {
    /// JPEG (ISO/IEC 10918).
    #[serde(rename = "image/jpeg")]
    Jpeg,
    /// PNG (RFC 2083).
    #[serde(rename = "image/png")]
    Png,
    /// WebP (RFC 9649).
    #[serde(rename = "image/webp")]
    Webp,
    /// The Netpbm formats PBM, PGM, PPM and PAM (`P1` to `P7`).
    #[serde(rename = "image/x-portable-anymap")]
    Pnm,
    /// TIFF 6.0 and BigTIFF; the first picture of the file.
    #[serde(rename = "image/tiff")]
    Tiff,
    /// Windows bitmap.
    #[serde(rename = "image/bmp")]
    Bmp,
    /// GIF; the first picture of the file.
    #[serde(rename = "image/gif")]
    Gif,
}

impl MediaType {
    /// The formats, for messages.
    pub const NAMES: &str = "JPEG, PNG, WebP, TIFF, BMP, GIF or PNM (PBM, PGM, PPM, PAM)";

    /// The value of a `Content-Type` header.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Jpeg => "image/jpeg",
            Self::Png => "image/png",
            Self::Webp => "image/webp",
            Self::Pnm => "image/x-portable-anymap",
            Self::Tiff => "image/tiff",
            Self::Bmp => "image/bmp",
            Self::Gif => "image/gif",
        }
    }

    /// The format's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
            Self::Webp => "WebP",
            Self::Pnm => "PNM",
            Self::Tiff => "TIFF",
            Self::Bmp => "BMP",
            Self::Gif => "GIF",
        }
    }

    /// The usual extension of file names.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Jpeg => "jpg",
            Self::Png => "png",
            Self::Webp => "webp",
            Self::Pnm => "pnm",
            Self::Tiff => "tif",
            Self::Bmp => "bmp",
            Self::Gif => "gif",
        }
    }

    /// Detects the format from the magic bytes; `None` for any other format.
    pub fn sniff(bytes: &[u8]) -> Option<Self> {
        const TIFF: [&[u8]; 4] = [b"II*\0", b"MM\0*", b"II+\0\x08\0\0\0", b"MM\0+\0\x08\0\0"];
        // The size of the header that follows tells a bitmap from text that begins with BM.
        let is_bitmap = || {
            let size = bytes.get(14..18).and_then(|size| size.try_into().ok());
            size.map(u32::from_le_bytes).is_some_and(|size| matches!(size, 12 | 16 | 40..=124))
        };
        match bytes {
            [0xFF, 0xD8, 0xFF, ..] => Some(Self::Jpeg),
            [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Some(Self::Webp),
            [b'P', b'1'..=b'7', b' ' | b'\t' | b'\n' | b'\r' | b'#', ..] => Some(Self::Pnm),
            [b'B', b'M', ..] if is_bitmap() => Some(Self::Bmp),
            _ if bytes.starts_with(b"\x89PNG\r\n\x1a\n") => Some(Self::Png),
            _ if TIFF.iter().any(|magic| bytes.starts_with(magic)) => Some(Self::Tiff),
            _ if bytes.starts_with(b"GIF87a") || bytes.starts_with(b"GIF89a") => Some(Self::Gif),
            _ => None,
        }
    }
}

/// The record of a reference image. Its bytes are stored under its digest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Image {
    /// Id within the map.
    pub id: ImageId,
    /// SHA-256 of the bytes: `sha256:` and 64 hexadecimal digits.
    #[schema(value_type = String)]
    pub digest: Digest,
    /// Pose of the camera, if known.
    pub pose: Option<Pose>,
    /// When the picture was taken, if known.
    pub captured_at: Option<Timestamp>,
    /// Tags given by the operator.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Format of the picture.
    pub media_type: MediaType,
    /// Width in pixels, after applying the EXIF orientation.
    pub width: u32,
    /// Height in pixels, after applying the EXIF orientation.
    pub height: u32,
    /// When the image was stored.
    pub created_at: Timestamp,
}

/// A field of an image that can be changed after the image was stored. Its id, its bytes and its descriptor
/// cannot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ImageField {
    /// The pose of the camera.
    Pose,
    /// When the picture was taken.
    CapturedAt,
    /// The tags.
    Tags,
}

impl ImageField {
    /// The name used in the API.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Pose => "pose",
            Self::CapturedAt => "captured_at",
            Self::Tags => "tags",
        }
    }
}

impl Image {
    /// Returns the changeable fields whose values differ from those of `other`.
    pub fn differences(&self, other: &Self) -> Vec<ImageField> {
        let differs = [
            (ImageField::Pose, self.pose != other.pose),
            (ImageField::CapturedAt, self.captured_at != other.captured_at),
            (ImageField::Tags, self.tags != other.tags),
        ];
        differs.into_iter().filter(|(_, differs)| *differs).map(|(field, _)| field).collect()
    }
}

/// The place of an image in a recording. Robots drive along the images of a map in the order in which they were
/// recorded, whatever the order in which they arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Recording {
    /// The recording: a UUID of the sender's choice, the same for all of its images.
    pub id: Uuid,
    /// The number of the image in it.
    pub number: u32,
}

impl Recording {
    /// Sorts images in the order of recording. `place` returns the position of an image in the order of addition, and
    /// its place in a recording. A recording is where its first image was added; images without one are where they were
    /// added themselves.
    pub fn sort<T>(images: &mut [T], place: impl Fn(&T) -> (usize, Option<Self>)) {
        let mut starts: HashMap<Uuid, usize> = HashMap::new();
        for (position, recording) in images.iter().map(&place) {
            if let Some(Self { id, .. }) = recording {
                let start = starts.entry(id).or_insert(position);
                *start = position.min(*start);
            }
        }
        images.sort_by_key(|image| {
            let (position, recording) = place(image);
            let within =
                recording.and_then(|Self { id, number }| Some((*starts.get(&id)?, number)));
            let (start, number) = within.unwrap_or((position, 0));
            (start, number, position)
        });
    }
}

/// An image with its descriptor, as exported and imported.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ExportedImage {
    /// The record of the image.
    pub image: Image,
    /// The descriptor as base64 of little-endian 32-bit floats. Null if the stored descriptor is damaged.
    #[schema(value_type = Option<String>)]
    pub descriptor: Option<Descriptor>,
    /// Its position in the order of addition, with gaps where images were removed. Ignored in an import.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position: Option<u64>,
    /// Its place in a recording, if its sender said so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<Recording>,
    /// What was read in it; null if it was not read yet, or no reader is installed.
    #[serde(default)]
    pub texts: Option<ImageTexts>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_is_in_its_own_order_where_its_first_image_was_added() {
        let of = |id: u128, number| Some(Recording { id: Uuid::from_u128(id), number });
        let mut images = [
            (0, None),
            (1, of(7, 3)),
            (2, of(9, 0)),
            (3, None),
            (4, of(7, 0)),
            (5, of(9, 1)),
            (6, of(7, 3)),
        ];
        images.reverse();
        Recording::sort(&mut images, |image| *image);
        assert_eq!(images.map(|(position, _)| position), [0, 4, 1, 6, 2, 5, 3]);
    }

    #[test]
    fn file_names_common_in_the_field_are_valid_ids() {
        for id in ["@0543256.12@4178901.33@.jpg", "street/0001.jpg", "東京-01"] {
            assert!(id.parse::<ImageId>().is_ok(), "{id}");
        }
        for id in ["", ".", "..", " a", "a\n", &"x".repeat(201)] {
            assert!(id.parse::<ImageId>().is_err(), "{id:?}");
        }
    }

    #[test]
    fn the_format_is_detected_from_the_magic_bytes() {
        assert_eq!(MediaType::sniff(b"\xFF\xD8\xFF\xE0"), Some(MediaType::Jpeg));
        assert_eq!(MediaType::sniff(b"RIFF\0\0\0\0WEBPVP8 "), Some(MediaType::Webp));
        assert_eq!(MediaType::sniff(b"P5\n2 2\n255\n"), Some(MediaType::Pnm));
        assert_eq!(MediaType::sniff(b"II*\0"), Some(MediaType::Tiff));
        assert_eq!(MediaType::sniff(b"MM\0+\0\x08\0\0"), Some(MediaType::Tiff));
        assert_eq!(MediaType::sniff(b"GIF89a"), Some(MediaType::Gif));
        let bitmap = [b"BM".as_slice(), &[0; 12], &[40, 0, 0, 0]].concat();
        assert_eq!(MediaType::sniff(&bitmap), Some(MediaType::Bmp));
        for other in [b"BMW, 40 of them".as_slice(), b"P8\n", b"Pf\n", b"II", b"GIF88a"] {
            assert_eq!(MediaType::sniff(other), None);
        }
        assert_eq!(MediaType::sniff(b""), None);
    }
}
