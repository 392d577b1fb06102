//! Formats that are recognised and refused, so that the refusal can name them and say how to convert.

/// Describes a format that the service does not read: its name, and what to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Foreign {
    /// Name of the format, with an article.
    pub name: &'static str,
    /// What the sender can do.
    pub remedy: &'static str,
}

const CONVERT: &str = "convert it first, for example with `ffmpeg -i IN OUT.jpg`";

impl Foreign {
    /// Recognises a format by its first bytes.
    pub fn sniff(bytes: &[u8]) -> Option<Self> {
        let as_is = |name, remedy| Some(Self { name, remedy });
        if let Some(brand) = iso_brand(bytes) {
            return match brand {
                b"heic" | b"heix" | b"heim" | b"heis" | b"hevc" | b"hevx" | b"mif1" | b"msf1" => {
                    as_is(
                        "a HEIC picture",
                        "convert it with `heif-convert IN.heic OUT.jpg` (libheif) or `sips -s format jpeg \
                         IN.heic --out OUT.jpg` (macOS), or set the phone's camera to the format \"Most \
                         Compatible\"",
                    )
                }
                b"avif" | b"avis" => as_is(
                    "an AVIF picture",
                    "convert it with `avifdec IN.avif OUT.png` (libavif) or `ffmpeg -i IN.avif OUT.png`",
                ),
                b"jxl " => as_is("a JPEG XL picture", "convert it with `djxl IN.jxl OUT.jpg`"),
                b"jp2 " => as_is("a JPEG 2000 picture", CONVERT),
                b"crx " => as_is("a camera raw file (CR3)", RAW),
                _ => as_is("a video", "send single frames: `ffmpeg -i IN -vf fps=1 %06d.jpg`"),
            };
        }
        let starts = |magic: &[u8]| bytes.starts_with(magic);
        if starts(b"\xFF\x0A") {
            as_is("a JPEG XL picture", "convert it with `djxl IN.jxl OUT.jpg`")
        } else if starts(b"\xFF\x4F\xFF\x51") {
            as_is("a JPEG 2000 picture", CONVERT)
        } else if starts(b"\x1AE\xDF\xA3") || (starts(b"RIFF") && bytes.get(8..12) == Some(b"AVI "))
        {
            as_is("a video", "send single frames: `ffmpeg -i IN -vf fps=1 %06d.jpg`")
        } else if starts(b"II*\0\x10\0\0\0CR") {
            as_is("a camera raw file (CR2)", RAW)
        } else if starts(b"FUJIFILMCCD-RAW") || starts(b"IIRO") || starts(b"IIU\0") {
            as_is("a camera raw file", RAW)
        } else if starts(b"PF\n") || starts(b"Pf\n") || starts(b"\x76\x2F\x31\x01") {
            as_is(
                "a picture of floating-point numbers",
                "scale it to 8 or 16 bits and save it as PNG",
            )
        } else if starts(b"qoif") || starts(b"8BPS") || starts(b"\0\0\x01\0") || starts(b"DDS ") {
            as_is("a picture in a format that the service does not read", CONVERT)
        } else if starts(b"%PDF") {
            as_is("a PDF document", "send its pictures: `pdfimages -all IN.pdf OUT`")
        } else if starts(b"\x1F\x8B") || starts(b"PK\x03\x04") || starts(b"\x28\xB5\x2F\xFD") {
            as_is("a compressed archive", "unpack it and send the pictures")
        } else if starts(b"version https://git-lfs") {
            as_is("a Git LFS pointer and not the picture itself", "run `git lfs pull` first")
        } else if is_markup(bytes) {
            as_is(
                "an HTML, XML or SVG text, perhaps an error page that was saved under the name of a picture",
                "check where the file comes from",
            )
        } else {
            None
        }
    }

    /// Recognises camera raw files, which are TIFF files whose first picture is a thumbnail.
    pub fn in_tiff(bytes: &[u8]) -> Option<Self> {
        const NEW_SUBFILE_TYPE: u16 = 254;
        const CFA_PATTERN: u16 = 33422;
        const DNG_VERSION: u16 = 50706;
        const SUB_IFDS: u16 = 330;
        const COLOUR_FILTER_ARRAY: u32 = 32803;
        const PHOTOMETRIC: u16 = 262;
        let tags = first_directory(bytes)?;
        let value = |tag| tags.iter().find(|(name, _)| *name == tag).map(|(_, value)| *value);
        let is_thumbnail = value(NEW_SUBFILE_TYPE).is_some_and(|kind| kind & 1 == 1);
        let is_raw = value(DNG_VERSION).is_some()
            || value(CFA_PATTERN).is_some()
            || value(PHOTOMETRIC) == Some(COLOUR_FILTER_ARRAY)
            || (is_thumbnail && value(SUB_IFDS).is_some());
        is_raw.then_some(Self { name: "a camera raw file (DNG, NEF or the like)", remedy: RAW })
    }
}

const RAW: &str = "develop it to JPEG or TIFF first, for example with `darktable-cli IN OUT.jpg`";

/// The major brand of an ISO base media file.
fn iso_brand(bytes: &[u8]) -> Option<&[u8; 4]> {
    match bytes {
        [0, 0, _, _, b'f', b't', b'y', b'p', rest @ ..] => rest.first_chunk(),
        [0, 0, 0, 12, b'J', b'X', b'L', b' ', ..] => Some(b"jxl "),
        [0, 0, 0, 12, b'j', b'P', b' ', b' ', ..] => Some(b"jp2 "),
        _ => None,
    }
}

fn is_markup(bytes: &[u8]) -> bool {
    let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes).trim_ascii_start();
    let head = text.get(..text.len().min(9)).unwrap_or_default().to_ascii_lowercase();
    [b"<!doctype".as_slice(), b"<html", b"<?xml", b"<svg", b"<error"]
        .iter()
        .any(|start| head.starts_with(start))
}

/// Tags and inline values of the first directory of a classic TIFF file.
fn first_directory(bytes: &[u8]) -> Option<Vec<(u16, u32)>> {
    const MAX_TAGS: usize = 512;
    let is_little = bytes.starts_with(b"II");
    let u16_at = |at: usize| {
        let two = *bytes.get(at..)?.first_chunk()?;
        Some(if is_little { u16::from_le_bytes(two) } else { u16::from_be_bytes(two) })
    };
    let u32_at = |at: usize| {
        let four = *bytes.get(at..)?.first_chunk()?;
        Some(if is_little { u32::from_le_bytes(four) } else { u32::from_be_bytes(four) })
    };
    let start = u32_at(4)? as usize;
    let count = usize::from(u16_at(start)?).min(MAX_TAGS);
    let tag = |index: usize| {
        let at = start.checked_add(2 + 12 * index)?;
        const SHORT: u16 = 3;
        let value = match u16_at(at + 2)? {
            SHORT => u32::from(u16_at(at + 8)?),
            _ => u32_at(at + 8)?,
        };
        Some((u16_at(at)?, value))
    };
    Some((0..count).map_while(tag).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn common_formats_are_named_with_a_way_to_convert_them() {
        for (bytes, name, remedy) in [
            (b"\0\0\0\x18ftypheic\0\0\0\0".as_slice(), "HEIC", "heif-convert"),
            (b"\0\0\0\x1Cftypavif", "AVIF", "avifdec"),
            (b"\0\0\0\x0CJXL \r\n\x87\n", "JPEG XL", "djxl"),
            (b"\xFF\x0A\0", "JPEG XL", "djxl"),
            (b"\0\0\0\x20ftypisom", "video", "ffmpeg"),
            (b"II*\0\x10\0\0\0CR\x02\0", "raw", "darktable"),
            (b"PF\n2 2\n-1.0\n", "floating-point", "PNG"),
            (b"\x1F\x8B\x08", "archive", "unpack"),
            (b"version https://git-lfs.github.com/spec/v1", "LFS", "git lfs pull"),
            (b"\r\n<!DOCTYPE html>", "HTML", "where"),
            (b"<svg xmlns", "SVG", "where"),
        ] {
            let foreign = Foreign::sniff(bytes).unwrap();
            assert!(foreign.name.contains(name), "{foreign:?}");
            assert!(foreign.remedy.contains(remedy), "{foreign:?}");
        }
        assert_eq!(Foreign::sniff(b"hello"), None);
        assert_eq!(Foreign::sniff(b""), None);
    }

    #[test]
    fn a_raw_file_is_told_from_a_tiff() {
        let with_tag = |tag: u16, value: u32| {
            let head = [b"II*\0\x08\0\0\0\x01\0".as_slice(), &tag.to_le_bytes()].concat();
            [head.as_slice(), b"\x04\0\x01\0\0\0", &value.to_le_bytes(), &[0; 4]].concat()
        };
        assert!(Foreign::in_tiff(&with_tag(50706, 1)).is_some());
        assert!(Foreign::in_tiff(&with_tag(262, 32803)).is_some());
        assert!(Foreign::in_tiff(&with_tag(254, 1)).is_none());
        assert!(Foreign::in_tiff(&with_tag(262, 1)).is_none());
        let whole = with_tag(50706, 1);
        (0..18).for_each(|cut| assert!(Foreign::in_tiff(&whole[..cut]).is_none()));
    }
}
