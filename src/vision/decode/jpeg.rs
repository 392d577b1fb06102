//! JPEG decoding: the markers are parsed here, the pixels are decoded by libjpeg-turbo, which also decoded the
//! training images of the published models.

use std::cell::Cell;
use std::ffi::c_int;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::ptr;

use image::RgbImage;
use image::metadata::Orientation;
use mozjpeg::Decompress;
use mozjpeg_sys::jpeg_error_mgr;

/// The end-of-image marker.
pub(super) const END: &[u8] = &[0xFF, 0xD9];

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
    /// Whether the file has an end-of-image marker.
    pub is_ended: bool,
    /// Whether the picture comes in several scans, each of which covers all of it.
    is_progressive: bool,
    /// The restart markers, if the picture has any.
    restarts: Option<Restarts>,
    /// Position of the end-of-image marker.
    end: usize,
}

/// Restart markers divide the data of a picture into intervals, so that damage ends with its interval.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Restarts {
    /// Markers that the size of the picture asks for.
    expected: usize,
    /// Markers that are there.
    found: usize,
    /// Markers up to the first whose number is wrong; they count from 0 to 7 and again.
    in_order: usize,
}

impl Restarts {
    /// The share of the picture before the first interval that was lost; `None` if all are there. Some cameras write
    /// a marker too many, before the end.
    fn intact(self) -> Option<f64> {
        let Self { expected, found, in_order } = self;
        let is_whole = in_order == found && (found == expected || found == expected + 1);
        // Eight lost intervals leave the numbers in order.
        let share = if in_order < found { in_order as f64 / found as f64 } else { 0.0 };
        (!is_whole).then_some(share)
    }
}

/// Why the markers are malformed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Malformed {
    /// The file ends before its first scan.
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

    /// Parses the markers of a file up to its end-of-image marker, or up to its end if it has scans.
    ///
    /// Bytes after the end-of-image marker are allowed, because some cameras append a preview and some webcams pad
    /// their frames.
    pub fn read(bytes: &[u8]) -> Result<Self, Malformed> {
        const END_OF_IMAGE: u8 = 0xD9;
        const START_OF_SCAN: u8 = 0xDA;
        const APPLICATION_1: u8 = 0xE1;
        const RESTART_INTERVAL: u8 = 0xDD;
        const PROGRESSIVE: [u8; 2] = [0xC2, 0xCA];
        let (mut frame, mut orientation, mut scans) = (None, Orientation::NoTransforms, 0);
        let (mut is_progressive, mut is_ended, mut at) = (false, false, 2);
        let (mut interval, mut blocks, mut numbers) = (0, None, Vec::new());
        while let Some((marker, next)) = next_marker(bytes, at) {
            match marker {
                END_OF_IMAGE => {
                    (is_ended, at) = (true, next - 2);
                    break;
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
                            at = end_of_scan(bytes, at, &mut numbers);
                        }
                        APPLICATION_1 => {
                            orientation = exif_orientation(segment).unwrap_or(orientation)
                        }
                        RESTART_INTERVAL => interval = restart_interval(segment),
                        // Frame headers; three codes in the range are not.
                        0xC0..=0xCF if !matches!(marker, 0xC4 | 0xC8 | 0xCC) => {
                            is_progressive |= PROGRESSIVE.contains(&marker);
                            frame = frame.or_else(|| frame_header(segment));
                            blocks = blocks.or_else(|| blocks_of(segment));
                        }
                        _ => {}
                    }
                }
            }
        }
        if !is_ended && scans == 0 {
            return Err(Malformed::Truncated);
        }
        let (width, height, components) = frame.ok_or(Malformed::NoFrame)?;
        is_progressive |= scans > 1;
        let end = at.min(bytes.len());
        let restarts = blocks.filter(|_| interval > 0 && scans == 1).map(|blocks| Restarts {
            expected: blocks.div_ceil(interval).saturating_sub(1),
            found: numbers.len(),
            in_order: numbers.iter().zip((0..8).cycle()).take_while(|(n, o)| **n == *o).count(),
        });
        Ok(Self { width, height, components, orientation, is_ended, is_progressive, restarts, end })
    }
}

/// The pixels of a JPEG.
#[derive(Debug)]
pub(super) struct Decoded {
    /// The pixels, without applying the orientation.
    pub pixels: RgbImage,
    /// The share of the rows, from the top, before the decoder met missing or changed bytes; 1 in a file that is
    /// intact.
    pub intact: f64,
}

/// Decodes a picture at `eighths` / 8 of its size (1, 2, 4 or 8; both edges are rounded up), without applying the
/// orientation.
///
/// The reduction happens in the frequency domain, by inverse transforms of the low frequencies only. The result
/// is an area average and takes a fraction of the time.
pub(super) fn decode(bytes: &[u8], outline: Outline, eighths: u8) -> Result<Decoded, String> {
    // libjpeg reports an error by unwinding from its callback.
    let decoded = catch_unwind(AssertUnwindSafe(|| {
        let builder = Decompress::with_err(counting_errors());
        let mut decoder = builder.from_mem(bytes)?;
        // The size that was checked against the limits must be the size that is decoded.
        if decoder.size() != (outline.width as usize, outline.height as usize) {
            return Err(io::Error::other("its headers contradict each other"));
        }
        decoder.scale(eighths);
        // Oddities of the headers are no damage.
        WARNINGS.set(0);
        let mut rows = decoder.rgb()?;
        if !outline.is_progressive {
            WARNINGS.set(0);
        }
        let (width, height) = (rows.width(), rows.height());
        let mut pixels = vec![0; width * height * 3];
        // Many webcams write a few bytes too many before each restart marker, of which the decoder warns as of
        // damage. Their markers tell.
        let restarts = outline.restarts.filter(|_| !outline.is_progressive);
        let tolerated = restarts.map_or(0, |restarts| restarts.found as u32);
        let (mut read, mut intact) = (0, restarts.and_then(Restarts::intact));
        for part in pixels.chunks_mut(width * 3 * ROWS_AT_A_TIME) {
            rows.read_scanlines_into(part)?;
            if WARNINGS.get() > tolerated {
                intact = intact.or(Some(read as f64 / height as f64));
            }
            read += ROWS_AT_A_TIME;
        }
        if intact.is_none() && outline.is_ended && has_leftover(rows, bytes, outline) {
            intact = Some(0.0);
        }
        let pixels = RgbImage::from_raw(width as u32, height as u32, pixels);
        let pixels = pixels.ok_or_else(|| io::Error::other("rows are missing"))?;
        Ok(Decoded { pixels, intact: intact.unwrap_or(1.0) })
    }));
    match decoded {
        Ok(result) => result.map_err(|error: io::Error| error.to_string()),
        Err(_) => Err(reason(bytes)),
    }
}

/// Rows between two looks at the number of warnings.
const ROWS_AT_A_TIME: usize = 16;

thread_local! {
    /// Warnings of the decoder on this thread since the number was reset.
    static WARNINGS: Cell<u32> = const { Cell::new(0) };
}

/// The callbacks of a decoder: warnings are counted, errors unwind. The decoder warns of missing and changed bytes and
/// fills the picture with grey or noise; libjpeg's own callbacks would print to standard error and exit.
fn counting_errors() -> jpeg_error_mgr {
    extern "C-unwind" fn unwind<T>(_: &mut T) {
        // Without the panic hook: a damaged picture is no panic.
        resume_unwind(Box::new(()));
    }
    extern "C-unwind" fn count<T>(_: &mut T, level: c_int) {
        if level < 0 {
            WARNINGS.set(WARNINGS.get().saturating_add(1));
        }
    }
    extern "C-unwind" fn ignore<T>(_: &mut T) {}
    extern "C-unwind" fn leave<T>(_: &mut T, _: &[u8; 80]) {}
    jpeg_error_mgr {
        error_exit: Some(unwind),
        emit_message: Some(count),
        output_message: Some(ignore),
        format_message: Some(leave),
        reset_error_mgr: Some(ignore),
        msg_code: 0,
        msg_parm: Default::default(),
        trace_level: 0,
        num_warnings: 0,
        jpeg_message_table: ptr::null(),
        last_jpeg_message: 0,
        addon_message_table: ptr::null(),
        first_addon_message: 0,
        last_addon_message: 0,
    }
}

/// Whether data of the picture is left over after its last row: bytes before them were lost. Constant bytes are the
/// padding of a camera.
fn has_leftover(
    rows: mozjpeg::decompress::DecompressStarted<&[u8]>,
    bytes: &[u8],
    outline: Outline,
) -> bool {
    WARNINGS.set(0);
    let is_finished = rows.finish().is_ok();
    let is_padded = match bytes.get(..outline.end) {
        Some([.., a, b, c]) => a == b && b == c,
        _ => false,
    };
    !is_padded && (WARNINGS.get() > 0 || !is_finished)
}

/// Decodes a picture that failed once more for the words of the decoder.
fn reason(bytes: &[u8]) -> String {
    let again = catch_unwind(AssertUnwindSafe(|| {
        let mut rows = Decompress::new_mem(bytes)?.rgb()?;
        rows.read_scanlines::<u8>().map(drop)
    }));
    let reason = match again {
        Ok(result) => result.err().map(|error| error.to_string()),
        Err(reason) => reason.downcast::<String>().ok().map(|reason| *reason),
    };
    let reason = reason.unwrap_or_else(|| "it is damaged".to_owned());
    reason.trim_start_matches("libjpeg fatal error: ").to_owned()
}

/// Finds the next marker at or after `at`. Returns its code and the position of the bytes after it.
fn next_marker(bytes: &[u8], at: usize) -> Option<(u8, usize)> {
    let start = at + bytes.get(at..)?.iter().position(|&b| b == 0xFF)?;
    let code = start + bytes[start..].iter().position(|&b| b != 0xFF)?;
    Some((bytes[code], code + 1))
}

/// Finds the end of entropy-coded data: the first marker that is neither a stuffed byte nor a restart. Adds the numbers
/// of the restart markers to `restarts`.
fn end_of_scan(bytes: &[u8], mut at: usize, restarts: &mut Vec<u8>) -> usize {
    while let Some(offset) = bytes.get(at..).and_then(|rest| rest.iter().position(|&b| b == 0xFF)) {
        at += offset;
        match bytes.get(at + 1) {
            Some(0x00) => at += 2,
            Some(restart @ 0xD0..=0xD7) => {
                restarts.push(restart - 0xD0);
                at += 2;
            }
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

fn restart_interval(segment: &[u8]) -> usize {
    let interval = segment.first_chunk().map_or(0, |interval| u16::from_be_bytes(*interval));
    interval.into()
}

/// Counts the minimum coded units of a picture with one scan (A.2 of the standard).
fn blocks_of(segment: &[u8]) -> Option<usize> {
    let (width, height, components) = frame_header(segment)?;
    let factors = segment.get(6..)?.chunks_exact(3).take(components.into()).map(|part| part[1]);
    let (across, down) = match components {
        1 => (1, 1),
        _ => (factors.clone().map(|f| f >> 4).max()?, factors.map(|f| f & 15).max()?),
    };
    let count = |edge: u32, factor: u8| edge.div_ceil(8 * u32::from(factor.max(1))) as usize;
    Some(count(width, across) * count(height, down))
}

fn exif_orientation(segment: &[u8]) -> Option<Orientation> {
    Orientation::from_exif_chunk(segment.strip_prefix(b"Exif\0\0")?)
}
