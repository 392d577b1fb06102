//! JPEG decoding: the markers are parsed here, the pixels are decoded by libjpeg-turbo, which also decoded the
//! training images of the published models.

use std::panic::{AssertUnwindSafe, catch_unwind};

use image::RgbImage;
use image::metadata::Orientation;
use mozjpeg::Decompress;

/// Maximum scans of a progressive JPEG. Cameras write about ten. Each scan costs a pass over the whole picture,
/// so a small file with thousands of scans would keep a core busy for minutes.
const MAX_SCANS: usize = 200;

/// The contents of a JPEG's markers (ISO/IEC 10918-1, annex B).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Outline {
    /// Width in pixels, as stored.
    pub width: u32,
    /// Height in pixels, as stored.
    pub height: u32,
    /// Colour components: 1 for grey, 3 for colour, 4 for CMYK.
    pub components: u8,
    /// EXIF orientation.
    pub orientation: Orientation,
}

/// Why the markers are malformed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Malformed {
    /// The end-of-image marker is missing.
    Truncated,
    /// There is no frame header.
    NoFrame,
    /// There are more than [`MAX_SCANS`].
    TooManyScans,
}

impl Outline {
    /// Width and height in pixels, after applying the orientation.
    pub fn upright(&self) -> (u32, u32) {
        use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
        match self.orientation {
            Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH => (self.height, self.width),
            _ => (self.width, self.height),
        }
    }

    /// Parses the markers of a file up to its end-of-image marker.
    ///
    /// Decoders made for browsers fill the missing part of a truncated file with grey and report success. A
    /// frame that was truncated in transit must not be localized by its upper half. Bytes after the
    /// end-of-image marker are allowed, because some cameras append a preview.
    pub fn read(bytes: &[u8]) -> Result<Self, Malformed> {
        const END_OF_IMAGE: u8 = 0xD9;
        const START_OF_SCAN: u8 = 0xDA;
        const APPLICATION_1: u8 = 0xE1;
        let (mut frame, mut orientation, mut scans) = (None, Orientation::NoTransforms, 0);
        let mut at = 2;
        while let Some((marker, next)) = next_marker(bytes, at) {
            match marker {
                END_OF_IMAGE => {
                    let (width, height, components) = frame.ok_or(Malformed::NoFrame)?;
                    return Ok(Self { width, height, components, orientation });
                }
                // Markers without a segment: restarts, start of image, and TEM.
                0xD0..=0xD8 | 0x01 => at = next,
                _ => {
                    let Some(length) = bytes.get(next..next + 2) else { break };
                    at = next + usize::from(u16::from_be_bytes([length[0], length[1]]));
                    let segment = bytes.get(next + 2..at).unwrap_or_default();
                    match marker {
                        START_OF_SCAN => {
                            scans += 1;
                            if scans > MAX_SCANS {
                                return Err(Malformed::TooManyScans);
                            }
                            at = end_of_scan(bytes, at);
                        }
                        APPLICATION_1 => {
                            orientation = exif_orientation(segment).unwrap_or(orientation)
                        }
                        // Frame headers; three codes in the range are not.
                        0xC0..=0xCF if !matches!(marker, 0xC4 | 0xC8 | 0xCC) => {
                            frame = frame.or_else(|| frame_header(segment));
                        }
                        _ => {}
                    }
                }
            }
        }
        Err(Malformed::Truncated)
    }
}

/// Decodes a picture at `eighths` / 8 of its size (1, 2, 4 or 8; both edges are rounded up), without applying the
/// orientation.
///
/// The reduction happens in the frequency domain, by inverse transforms of the low frequencies only. The result
/// is an area average and takes a fraction of the time.
pub(super) fn decode(bytes: &[u8], outline: Outline, eighths: u8) -> Result<RgbImage, String> {
    // libjpeg reports an error by unwinding from its callback.
    let decoded = catch_unwind(AssertUnwindSafe(|| {
        let mut decoder = Decompress::new_mem(bytes)?;
        // The size that was checked against the limits must be the size that is decoded.
        if decoder.size() != (outline.width as usize, outline.height as usize) {
            return Err(std::io::Error::other("its headers contradict each other"));
        }
        decoder.scale(eighths);
        let mut rows = decoder.rgb()?;
        let (width, height) = (rows.width() as u32, rows.height() as u32);
        let pixels = rows.read_scanlines::<u8>()?;
        Ok((width, height, pixels))
    }));
    let (width, height, pixels) = match decoded {
        Ok(result) => result.map_err(|error: std::io::Error| error.to_string())?,
        Err(reason) => {
            let reason =
                reason.downcast::<String>().map_or_else(|_| "it is damaged".into(), |r| *r);
            return Err(reason.trim_start_matches("libjpeg fatal error: ").to_owned());
        }
    };
    RgbImage::from_raw(width, height, pixels).ok_or_else(|| "rows are missing".to_owned())
}

/// Finds the next marker at or after `at`. Returns its code and the position of the bytes after it.
fn next_marker(bytes: &[u8], at: usize) -> Option<(u8, usize)> {
    let start = at + bytes.get(at..)?.iter().position(|&b| b == 0xFF)?;
    let code = start + bytes[start..].iter().position(|&b| b != 0xFF)?;
    Some((bytes[code], code + 1))
}

/// Finds the end of entropy-coded data: the first marker that is neither a stuffed byte nor a restart.
fn end_of_scan(bytes: &[u8], mut at: usize) -> usize {
    while let Some(offset) = bytes.get(at..).and_then(|rest| rest.iter().position(|&b| b == 0xFF)) {
        at += offset;
        match bytes.get(at + 1) {
            Some(0x00 | 0xD0..=0xD7) => at += 2,
            Some(0xFF) => at += 1,
            _ => return at,
        }
    }
    bytes.len()
}

/// Parses width, height and components from a frame header, whose first byte is the sample precision.
fn frame_header(segment: &[u8]) -> Option<(u32, u32, u8)> {
    let &[_, h0, h1, w0, w1, components, ..] = segment else { return None };
    let (width, height) = (u16::from_be_bytes([w0, w1]), u16::from_be_bytes([h0, h1]));
    Some((width.into(), height.into(), components))
}

fn exif_orientation(segment: &[u8]) -> Option<Orientation> {
    Orientation::from_exif_chunk(segment.strip_prefix(b"Exif\0\0")?)
}
