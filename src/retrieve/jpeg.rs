//! Whether a JPEG is whole.
//!
//! Decoders for browsers fill a missing rest with grey and report success. A robot's frame that
//! was cut in transit must not be localized by its upper half, so the markers are walked first.

/// Whether the markers of a JPEG (ISO/IEC 10918-1, annex B) lead to its end-of-image marker.
///
/// Bytes behind that marker are allowed, as some cameras append a preview.
pub(super) fn is_complete(bytes: &[u8]) -> bool {
    const END_OF_IMAGE: u8 = 0xD9;
    const START_OF_SCAN: u8 = 0xDA;
    let mut at = 2;
    while let Some((marker, next)) = next_marker(bytes, at) {
        match marker {
            END_OF_IMAGE => return true,
            // Markers that stand alone: restarts, start of image, and TEM.
            0xD0..=0xD8 | 0x01 => at = next,
            _ => {
                let Some(length) = bytes.get(next..next + 2) else { return false };
                at = next + usize::from(u16::from_be_bytes([length[0], length[1]]));
                if marker == START_OF_SCAN {
                    at = end_of_scan(bytes, at);
                }
            }
        }
    }
    false
}

/// The next marker code at or after `at`, and where the bytes behind it begin.
fn next_marker(bytes: &[u8], at: usize) -> Option<(u8, usize)> {
    let start = at + bytes.get(at..)?.iter().position(|&b| b == 0xFF)?;
    let code = start + bytes[start..].iter().position(|&b| b != 0xFF)?;
    Some((bytes[code], code + 1))
}

/// Where entropy-coded data ends: at the first marker that is neither a stuffed byte nor a restart.
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
