//! Reference images: pictures of a map, with the pose they were taken from.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Descriptor, Digest, InvalidName, Pose};

/// The id of an image within its map: 1 to 200 bytes of printable text.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "String", into = "String")]
pub struct ImageId(String);

impl ImageId {
    /// The longest id, in bytes of UTF-8.
    pub const MAX_BYTES: usize = 200;

    /// The id of an image that came without one: the head of its digest, so that the same bytes
    /// sent again are the same image.
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
            return refuse("must not hold control characters or begin or end with a space");
        }
        // A URL path with such a segment never reaches the server: clients resolve it away.
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
}

impl MediaType {
    /// The name in a `Content-Type`.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Jpeg => "image/jpeg",
            Self::Png => "image/png",
            Self::Webp => "image/webp",
        }
    }

    /// What the first bytes say; `None` for anything that is not one of the three.
    pub fn sniff(bytes: &[u8]) -> Option<Self> {
        if bytes.starts_with(&[0xFF, 0xD8, 0xFF]) {
            Some(Self::Jpeg)
        } else if bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
            Some(Self::Png)
        } else if bytes.len() >= 12 && &bytes[..4] == b"RIFF" && &bytes[8..12] == b"WEBP" {
            Some(Self::Webp)
        } else {
            None
        }
    }
}

/// A reference image as it is stored; its bytes are kept under its digest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Image {
    /// Its id within the map.
    pub id: ImageId,
    /// The SHA-256 of its bytes: `sha256:` and 64 hexadecimal digits.
    #[schema(value_type = String)]
    pub digest: Digest,
    /// Where it was taken from, if known.
    pub pose: Option<Pose>,
    /// When it was taken, if known.
    pub captured_at: Option<Timestamp>,
    /// Words an operator gave it.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Its format.
    pub media_type: MediaType,
    /// Width in pixels, as shown (after the EXIF orientation).
    pub width: u32,
    /// Height in pixels, as shown.
    pub height: u32,
    /// When it was stored.
    pub created_at: Timestamp,
}

/// An image with its descriptor, as it goes from one store to another.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ExportedImage {
    /// The image.
    pub image: Image,
    /// Base64 of its numbers: 32-bit floats, little-endian. Null if what is stored is damaged.
    #[schema(value_type = Option<String>)]
    pub descriptor: Option<Descriptor>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_from_the_fields_file_names_are_taken() {
        for id in ["@0543256.12@4178901.33@.jpg", "street/0001.jpg", "東京-01"] {
            assert!(id.parse::<ImageId>().is_ok(), "{id}");
        }
        for id in ["", ".", "..", " a", "a\n", &"x".repeat(201)] {
            assert!(id.parse::<ImageId>().is_err(), "{id:?}");
        }
    }

    #[test]
    fn a_format_is_told_by_its_first_bytes() {
        assert_eq!(MediaType::sniff(b"\xFF\xD8\xFF\xE0"), Some(MediaType::Jpeg));
        assert_eq!(MediaType::sniff(b"RIFF\0\0\0\0WEBPVP8 "), Some(MediaType::Webp));
        assert_eq!(MediaType::sniff(b"GIF89a"), None);
        assert_eq!(MediaType::sniff(b""), None);
    }
}
