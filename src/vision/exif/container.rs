//! Finds the EXIF data and XMP packets in the container formats of pictures. A damaged or cut container yields what
//! was found before the damage.

mod png;

use std::borrow::Cow;

/// Header of EXIF data in JPEG, HEIF and AVIF; PNG and WebP have it only from some writers.
const EXIF: &[u8] = b"Exif\0\0";

/// Header of an XMP packet in JPEG.
const XMP: &[u8] = b"http://ns.adobe.com/xap/1.0/\0";

/// Header of a part of the XMP data that do not fit into one segment of a JPEG.
const EXTENDED_XMP: &[u8] = b"http://ns.adobe.com/xmp/extension/\0";

/// Bytes behind that header: the digest of the whole, its length, and the offset of the part.
const EXTENDED_XMP_PART: usize = 32 + 4 + 4;

/// Header of an XMP packet in GIF.
const GIF_XMP: &[u8] = b"XMP DataXMP";

/// Most EXIF blocks, and most XMP packets, of one picture that are looked at.
pub(super) const MAX_BLOCKS: usize = 8;

/// Largest XMP packet, and largest block after decompression, that is looked at, in bytes.
const MAX_BYTES: usize = 1 << 20;

/// The metadata of a picture, in the order of the file.
#[derive(Debug, Default)]
pub(super) struct Metadata<'a> {
    /// EXIF data. Each should be a TIFF structure.
    pub exif: Vec<Cow<'a, [u8]>>,
    /// XMP packets.
    pub xmp: Vec<Cow<'a, [u8]>>,
}

impl<'a> Metadata<'a> {
    /// Finds the metadata of a picture.
    pub(super) fn find(bytes: &'a [u8]) -> Self {
        let mut found = Self::default();
        if bytes.starts_with(&[0xFF, 0xD8]) {
            found.jpeg(bytes);
        } else if bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
            found.png(bytes);
        } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
            found.webp(bytes);
        } else if is_tiff(bytes) {
            found.add_exif(Cow::Borrowed(bytes));
        } else if bytes.get(4..8) == Some(b"ftyp") {
            found.marked(bytes);
        } else if bytes.starts_with(b"GIF8") {
            found.gif(bytes);
        }
        found
    }

    fn add_exif(&mut self, block: Cow<'a, [u8]>) {
        if self.exif.len() < MAX_BLOCKS {
            self.exif.push(match block {
                Cow::Borrowed(block) => Cow::Borrowed(without_header(block)),
                Cow::Owned(block) => Cow::Owned(without_header(&block).to_vec()),
            });
        }
    }

    fn add_xmp(&mut self, packet: Cow<'a, [u8]>) {
        if self.xmp.len() < MAX_BLOCKS {
            self.xmp.push(match packet {
                Cow::Borrowed(packet) => Cow::Borrowed(bounded(packet)),
                Cow::Owned(packet) => Cow::Owned(bounded(&packet).to_vec()),
            });
        }
    }

    /// The APP1 segments of a JPEG that hold EXIF or XMP. Large EXIF data continue in the following APP1 segment.
    fn jpeg(&mut self, bytes: &'a [u8]) {
        const START_OF_SCAN: u8 = 0xDA;
        const END_OF_IMAGE: u8 = 0xD9;
        const APP1: u8 = 0xE1;
        let mut extended = Vec::new();
        let mut rest = bytes.get(2..).unwrap_or_default();
        // Skips fill bytes, and the padding that some cameras leave between segments.
        let is_marker = |pair: &[u8]| pair[0] == 0xFF && !matches!(pair[1], 0 | 0xFF);
        while let Some(start) = rest.windows(2).position(is_marker) {
            rest = &rest[start..];
            match rest[1] {
                START_OF_SCAN | END_OF_IMAGE => break,
                // Markers without a length.
                0x01 | 0xD0..=0xD8 => rest = &rest[2..],
                marker => {
                    let Some(length) = rest.get(2..4) else { break };
                    let end = 2 + usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
                    let segment = &rest[4..end.min(rest.len())];
                    if marker == APP1 {
                        self.app1(segment, &mut extended);
                    }
                    rest = &rest[end.min(rest.len())..];
                }
            }
        }
        if !extended.is_empty() {
            self.add_xmp(Cow::Owned(extended));
        }
    }

    fn app1(&mut self, segment: &'a [u8], extended: &mut Vec<u8>) {
        if let Some(packet) = segment.strip_prefix(XMP) {
            self.add_xmp(Cow::Borrowed(packet));
        } else if let Some(part) = segment.strip_prefix(EXTENDED_XMP) {
            if extended.len() < MAX_BYTES {
                extended.extend_from_slice(part.get(EXTENDED_XMP_PART..).unwrap_or_default());
            }
        } else if segment.starts_with(&EXIF[..5]) {
            let block = segment.get(EXIF.len()..).unwrap_or_default();
            match self.exif.last_mut().filter(|_| !is_tiff(block)) {
                Some(last) => last.to_mut().extend_from_slice(block),
                None => self.add_exif(Cow::Borrowed(block)),
            }
        }
    }

    /// The `EXIF` and `XMP` chunks of a WebP picture.
    fn webp(&mut self, bytes: &'a [u8]) {
        let mut rest = bytes.get(12..).unwrap_or_default();
        while let (Some(kind), Some(size)) = (rest.get(..4), rest.get(4..8)) {
            let length = u32::from_le_bytes([size[0], size[1], size[2], size[3]]) as usize;
            let data = &rest[8..length.saturating_add(8).min(rest.len())];
            match kind {
                b"EXIF" => self.add_exif(Cow::Borrowed(data)),
                // The last byte is a space; some writers write NUL.
                [b'X', b'M', b'P', _] => self.add_xmp(Cow::Borrowed(data)),
                _ => {}
            }
            let padded = length.saturating_add(length % 2).saturating_add(8);
            rest = rest.get(padded..).unwrap_or_default();
        }
    }

    /// The XMP packet of a GIF, which is stored as text in an application extension.
    fn gif(&mut self, bytes: &'a [u8]) {
        let start = bytes.windows(GIF_XMP.len()).position(|window| window == GIF_XMP);
        if let Some(start) = start {
            self.add_xmp(Cow::Borrowed(&bytes[start + GIF_XMP.len()..]));
        }
    }

    /// Blocks that are marked as EXIF in an ISO media file: HEIF and AVIF.
    fn marked(&mut self, bytes: &'a [u8]) {
        let mut rest = bytes;
        while let Some(start) = rest.windows(EXIF.len()).position(|window| window == EXIF) {
            rest = &rest[start + EXIF.len()..];
            if is_tiff(rest) {
                self.add_exif(Cow::Borrowed(rest));
            }
            if self.exif.len() == MAX_BLOCKS {
                break;
            }
        }
    }
}

/// Whether this begins like a TIFF structure. Cameras' raw formats have magic numbers of their own.
pub(super) fn is_tiff(bytes: &[u8]) -> bool {
    matches!(
        bytes.get(..4),
        Some(b"II*\0" | b"MM\0*" | b"IIU\0" | b"IIRO" | b"IIRS" | b"MMOR" | b"MMSR")
    )
}

fn without_header(data: &[u8]) -> &[u8] {
    data.strip_prefix(EXIF).unwrap_or(data)
}

/// The beginning of a packet that is looked at.
pub(super) fn bounded(data: &[u8]) -> &[u8] {
    &data[..data.len().min(MAX_BYTES)]
}
