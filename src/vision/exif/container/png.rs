//! The metadata of PNG pictures: chunks of their own, and texts in which programs hid them before there were any.

use std::borrow::Cow;
use std::io::Read;

use flate2::read::ZlibDecoder;

use super::{EXIF, MAX_BLOCKS, MAX_BYTES, Metadata, XMP};

/// Keyword of the text that is an XMP packet.
const XMP_KEYWORD: &[u8] = b"XML:com.adobe.xmp";

/// Keyword of metadata in hexadecimal digits, as ImageMagick, exiftool and darktable write them; its kind follows.
const RAW_PROFILE: &[u8] = b"Raw profile type ";

/// Longest keyword in bytes.
const LONGEST_KEYWORD: usize = 79;

impl<'a> Metadata<'a> {
    /// The metadata of a PNG, before or after the pixels.
    pub(super) fn png(&mut self, bytes: &'a [u8]) {
        let mut rest = bytes.get(8..).unwrap_or_default();
        let mut texts_left = MAX_BLOCKS;
        while let (Some(&[a, b, c, d]), Some(kind)) = (rest.first_chunk::<4>(), rest.get(4..8)) {
            let length = u32::from_be_bytes([a, b, c, d]) as usize;
            let data = &rest[8..length.saturating_add(8).min(rest.len())];
            match kind {
                b"eXIf" => self.add_exif(Cow::Borrowed(data)),
                // Each may be decompressed.
                b"tEXt" | b"zTXt" | b"iTXt" if texts_left > 0 && has_metadata(data) => {
                    texts_left -= 1;
                    self.text(kind, data);
                }
                b"IEND" => break,
                _ => {}
            }
            // Behind the data there is a checksum.
            rest = rest.get(length.saturating_add(12)..).unwrap_or_default();
        }
    }

    /// A chunk of text: its keyword, NUL, what its kind demands, and the text.
    fn text(&mut self, kind: &[u8], data: &'a [u8]) {
        let Some((keyword, rest)) = split_at_nul(data, LONGEST_KEYWORD + 1) else { return };
        let text = match kind {
            b"tEXt" => Some(Cow::Borrowed(rest)),
            // One byte is the method of compression.
            b"zTXt" => rest.get(1..).map(inflated),
            _ => international(rest),
        };
        let Some(text) = text else { return };
        let Some(profile) = keyword.strip_prefix(RAW_PROFILE) else { return self.add_xmp(text) };
        let block = decoded(&text);
        match profile.to_ascii_lowercase().as_slice() {
            b"exif" => self.add_exif(Cow::Owned(block)),
            b"xmp" => self.add_xmp(Cow::Owned(block)),
            b"app1" if block.starts_with(EXIF) => self.add_exif(Cow::Owned(block)),
            b"app1" => {
                if let Some(packet) = block.strip_prefix(XMP) {
                    self.add_xmp(Cow::Owned(packet.to_vec()));
                }
            }
            _ => {}
        }
    }
}

/// Whether the keyword of a text is one of those that are read.
fn has_metadata(data: &[u8]) -> bool {
    let keyword = split_at_nul(data, LONGEST_KEYWORD + 1).map(|(keyword, _)| keyword);
    let is_read = |keyword: &[u8]| match keyword.strip_prefix(RAW_PROFILE) {
        Some(kind) => [b"exif".as_slice(), b"xmp", b"app1"]
            .iter()
            .any(|known| kind.eq_ignore_ascii_case(known)),
        None => keyword == XMP_KEYWORD,
    };
    keyword.is_some_and(is_read)
}

/// Splits at the first NUL, which must be among the first `most` bytes.
fn split_at_nul(data: &[u8], most: usize) -> Option<(&[u8], &[u8])> {
    let end = data.iter().take(most).position(|&byte| byte == 0)?;
    Some((&data[..end], &data[end + 1..]))
}

/// The text of an `iTXt` chunk, behind two flags, the language and the translated keyword.
fn international(rest: &[u8]) -> Option<Cow<'_, [u8]>> {
    let (&is_compressed, rest) = rest.split_first()?;
    let (_method, rest) = rest.split_first()?;
    let (_language, rest) = split_at_nul(rest, usize::MAX)?;
    let (_keyword, text) = split_at_nul(rest, usize::MAX)?;
    Some(if is_compressed == 1 { inflated(text) } else { Cow::Borrowed(text) })
}

/// Decompresses what can be decompressed, up to a limit.
fn inflated(data: &[u8]) -> Cow<'_, [u8]> {
    // The digits of a raw profile are more than twice as long as what they say.
    let most = 3 * MAX_BYTES as u64;
    let mut text = Vec::new();
    // After damage, what came before it may be enough.
    let _ = ZlibDecoder::new(data).take(most).read_to_end(&mut text);
    Cow::Owned(text)
}

/// Decodes a raw profile: lines with its kind, its length, and hexadecimal digits.
fn decoded(text: &[u8]) -> Vec<u8> {
    let text = text.trim_ascii_start();
    let mut lines = text.splitn(2, |&byte| byte == b'\n');
    let (_kind, rest) = (lines.next(), lines.next().unwrap_or_default().trim_ascii_start());
    let mut lines = rest.splitn(2, |&byte| byte == b'\n');
    let (_length, digits) = (lines.next(), lines.next().unwrap_or_default());
    let value = |&digit: &u8| Some(char::from(digit).to_digit(16)? as u8);
    let values: Vec<u8> = digits.iter().filter_map(value).take(2 * MAX_BYTES).collect();
    values.chunks_exact(2).map(|pair| 16 * pair[0] + pair[1]).collect()
}
