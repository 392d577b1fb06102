//! Finds the EXIF data in the container formats of pictures. A damaged or cut container yields what was found
//! before the damage.

use std::borrow::Cow;

/// Header of EXIF data in JPEG, HEIF and AVIF; PNG and WebP have it only from some writers.
const EXIF: &[u8] = b"Exif\0\0";

/// Most EXIF blocks of one picture that are looked at.
const MAX_BLOCKS: usize = 8;

/// Returns the EXIF blocks of a picture in the order of the file. Each should be a TIFF structure.
pub(super) fn exif_blocks(bytes: &[u8]) -> Vec<Cow<'_, [u8]>> {
    if bytes.starts_with(&[0xFF, 0xD8]) {
        jpeg(bytes)
    } else if bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
        png(bytes)
    } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        webp(bytes)
    } else if is_tiff(bytes) {
        vec![Cow::Borrowed(bytes)]
    } else if bytes.get(4..8) == Some(b"ftyp") {
        marked(bytes)
    } else {
        Vec::new()
    }
}

/// Whether this begins like a TIFF structure. Cameras' raw formats have magic numbers of their own.
pub(super) fn is_tiff(bytes: &[u8]) -> bool {
    matches!(
        bytes.get(..4),
        Some(b"II*\0" | b"MM\0*" | b"IIU\0" | b"IIRO" | b"IIRS" | b"MMOR" | b"MMSR")
    )
}

/// The APP1 segments of a JPEG that hold EXIF. Large EXIF data continue in the following APP1 segment.
fn jpeg(bytes: &[u8]) -> Vec<Cow<'_, [u8]>> {
    const START_OF_SCAN: u8 = 0xDA;
    const END_OF_IMAGE: u8 = 0xD9;
    const APP1: u8 = 0xE1;
    let mut blocks: Vec<Cow<'_, [u8]>> = Vec::new();
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
                if marker == APP1 && segment.starts_with(&EXIF[..5]) {
                    let block = segment.get(EXIF.len()..).unwrap_or_default();
                    if let Some(last) = blocks.last_mut().filter(|_| !is_tiff(block)) {
                        last.to_mut().extend_from_slice(block);
                    } else if blocks.len() < MAX_BLOCKS {
                        blocks.push(Cow::Borrowed(block));
                    }
                }
                rest = &rest[end.min(rest.len())..];
            }
        }
    }
    blocks
}

/// The `eXIf` chunks of a PNG, before or after the pixels.
fn png(bytes: &[u8]) -> Vec<Cow<'_, [u8]>> {
    let mut blocks = Vec::new();
    let mut rest = bytes.get(8..).unwrap_or_default();
    while let (Some(&[a, b, c, d]), Some(kind)) = (rest.first_chunk::<4>(), rest.get(4..8)) {
        let length = u32::from_be_bytes([a, b, c, d]) as usize;
        let data = &rest[8..length.saturating_add(8).min(rest.len())];
        match kind {
            b"eXIf" => blocks.push(Cow::Borrowed(without_header(data))),
            b"IEND" => break,
            _ => {}
        }
        // Behind the data there is a checksum.
        rest = rest.get(length.saturating_add(12)..).unwrap_or_default();
    }
    blocks.truncate(MAX_BLOCKS);
    blocks
}

/// The `EXIF` chunks of a WebP picture.
fn webp(bytes: &[u8]) -> Vec<Cow<'_, [u8]>> {
    let mut blocks = Vec::new();
    let mut rest = bytes.get(12..).unwrap_or_default();
    while let (Some(kind), Some(size)) = (rest.get(..4), rest.get(4..8)) {
        let length = u32::from_le_bytes([size[0], size[1], size[2], size[3]]) as usize;
        if kind == b"EXIF" {
            let data = &rest[8..length.saturating_add(8).min(rest.len())];
            blocks.push(Cow::Borrowed(without_header(data)));
        }
        let padded = length.saturating_add(length % 2).saturating_add(8);
        rest = rest.get(padded..).unwrap_or_default();
    }
    blocks.truncate(MAX_BLOCKS);
    blocks
}

/// Blocks that are marked as EXIF in an ISO media file: HEIF and AVIF.
fn marked(bytes: &[u8]) -> Vec<Cow<'_, [u8]>> {
    let mut blocks = Vec::new();
    let mut rest = bytes;
    while let Some(start) = rest.windows(EXIF.len()).position(|window| window == EXIF) {
        rest = &rest[start + EXIF.len()..];
        if is_tiff(rest) {
            blocks.push(Cow::Borrowed(rest));
        }
        if blocks.len() == MAX_BLOCKS {
            break;
        }
    }
    blocks
}

fn without_header(data: &[u8]) -> &[u8] {
    data.strip_prefix(EXIF).unwrap_or(data)
}
