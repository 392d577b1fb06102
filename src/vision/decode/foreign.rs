//! Formats that are recognised and refused, so that the refusal can name them and say how to convert.

use whereabouts_core::MediaType;

/// Describes a format that the service does not read: its name, and what to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Foreign {
    /// Name of the format, with an article.
    pub name: &'static str,
    /// What the sender can do.
    pub remedy: &'static str,
}

const CONVERT: &str = "convert it first, for example with `ffmpeg -i IN OUT.jpg`";
const MAGICK: &str = "convert it first, for example with `magick IN OUT.png` (ImageMagick)";
const FRAMES: &str = "send single frames: `ffmpeg -i IN -vf fps=1 %06d.jpg`";
const UNPACK: &str = "unpack it and send the pictures";
const RAW: &str = "develop it to JPEG or TIFF first, for example with `darktable-cli IN OUT.jpg`";
const FLOATS: &str = "scale it to 8 or 16 bits and save it as PNG";
const DECODE: &str = "decode it and send the bytes themselves";
const RENDER: &str =
    "render it to PNG first, for example with `magick -density 150 IN OUT.png` (ImageMagick)";

/// Formats by their first bytes; of several that fit, the first.
const MAGIC: [(&[u8], &str, &str); 62] = [
    (b"\xFF\x0A", "a JPEG XL picture", "convert it with `djxl IN.jxl OUT.jpg`"),
    (b"\xFF\x4F\xFF\x51", "a JPEG 2000 picture", CONVERT),
    (b"II\xBC\x01", "a JPEG XR picture", "convert it with `JxrDecApp -i IN -o OUT.tif` (jxrlib)"),
    (
        b"8BPS",
        "a Photoshop picture (PSD)",
        "save it as PNG, or convert it with `magick IN[0] OUT.png` (ImageMagick)",
    ),
    (b"gimp xcf", "a GIMP picture (XCF)", "export it as PNG"),
    (b"qoif", "a QOI picture", CONVERT),
    (b"DDS ", "a DDS texture", CONVERT),
    (b"farbfeld", "a farbfeld picture", MAGICK),
    (b"FLIF", "a FLIF picture", "convert it with `flif -d IN OUT.png`"),
    (b"BPG\xFB", "a BPG picture", "convert it with `bpgdec -o OUT.png IN`"),
    (b"\x01\xDA", "an SGI picture", CONVERT),
    (b"\x59\xA6\x6A\x95", "a Sun raster picture", CONVERT),
    (b"AT&TFORM", "a DjVu document", "convert it with `ddjvu -format=tiff IN OUT.tif`"),
    (b"\x8AMNG\r\n", "an MNG animation", MAGICK),
    (b"\x8BJNG\r\n", "a JNG picture", MAGICK),
    (b"/* XPM */", "an XPM picture", MAGICK),
    (b"#define ", "an XBM picture or a source text", MAGICK),
    (b"\xD7\xCD\xC6\x9A", "a WMF drawing", RENDER),
    (b"%!PS", "a PostScript document", RENDER),
    (b"\xC5\xD0\xD3\xC6", "a PostScript document", RENDER),
    (b"%PDF", "a PDF document", "send its pictures: `pdfimages -all IN.pdf OUT`"),
    (b"PF\n", "a picture of floating-point numbers (PFM)", FLOATS),
    (b"Pf\n", "a picture of floating-point numbers (PFM)", FLOATS),
    (b"\x76\x2F\x31\x01", "a picture of floating-point numbers (OpenEXR)", FLOATS),
    (b"#?RADIANCE", "a picture of floating-point numbers (Radiance HDR)", FLOATS),
    (b"#?RGBE", "a picture of floating-point numbers (Radiance HDR)", FLOATS),
    (b"SIMPLE  =", "a FITS picture", FLOATS),
    (
        b"\x93NUMPY",
        "a NumPy array",
        "save it as PNG, or send its bytes with encoding=rgb8&width=640&height=480 in the query",
    ),
    (b"\x89HDF\r\n", "an HDF5 or MATLAB file", "save its pictures as PNG"),
    (b"MATLAB 5", "a MATLAB file", "save its pictures as PNG"),
    (b"#ROSBAG", "a ROS bag", "export its pictures first, for example with the package image_view"),
    (b"\x89MCAP", "an MCAP recording", "export its pictures first"),
    (b"SQLite format 3", "an SQLite database, perhaps a ROS 2 bag", "export its pictures first"),
    (b"II*\0\x10\0\0\0CR", "a camera raw file (CR2)", RAW),
    (b"II\x1A\0\0\0HEAPCCDR", "a camera raw file (CRW)", RAW),
    (b"FUJIFILMCCD-RAW", "a camera raw file (RAF)", RAW),
    (b"FOVb", "a camera raw file (X3F)", RAW),
    (b"\0MRM", "a camera raw file (MRW)", RAW),
    (b"IIRO", "a camera raw file (ORF)", RAW),
    (b"IIRS", "a camera raw file (ORF)", RAW),
    (b"MMOR", "a camera raw file (ORF)", RAW),
    (b"IIU\0", "a camera raw file (RW2)", RAW),
    (b"\x1AE\xDF\xA3", "a video", FRAMES),
    (b"\x30\x26\xB2\x75", "a video", FRAMES),
    (b"FLV\x01", "a video", FRAMES),
    (b"OggS", "a video or sound", FRAMES),
    (b"\0\0\x01\xBA", "a video", FRAMES),
    (b"\0\0\x01\xB3", "a video", FRAMES),
    (b"YUV4MPEG2", "a video", FRAMES),
    (b"\x1F\x8B", "a compressed archive", UNPACK),
    (b"PK\x03\x04", "a compressed archive", UNPACK),
    (b"\x28\xB5\x2F\xFD", "a compressed archive", UNPACK),
    (b"BZh", "a compressed archive", UNPACK),
    (b"\xFD7zXZ\0", "a compressed archive", UNPACK),
    (b"7z\xBC\xAF\x27\x1C", "a compressed archive", UNPACK),
    (b"Rar!\x1A\x07", "a compressed archive", UNPACK),
    (b"/9j/", "a JPEG in base64", DECODE),
    (b"iVBORw0KGgo", "a PNG in base64", DECODE),
    (b"UklGR", "a WebP picture in base64", DECODE),
    (b"data:image/", "a data URL", DECODE),
    (
        b"version https://git-lfs",
        "a Git LFS pointer and not the picture itself",
        "run `git lfs pull` first",
    ),
    (b"bplist00", "a property list of macOS", "send the picture itself"),
];

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
                _ => as_is("a video", FRAMES),
            };
        }
        let is = |(magic, ..): &&(&[u8], _, _)| bytes.starts_with(magic);
        if let Some((_, name, remedy)) = MAGIC.iter().find(is) {
            as_is(name, remedy)
        } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"AVI ") {
            as_is("a video", FRAMES)
        } else if MediaType::sniff(bytes).is_some() {
            None
        } else if bytes.get(257..262) == Some(b"ustar") {
            as_is(
                "a tar archive",
                "send it to `/maps/{map}/images:batch`, or send the pictures in it",
            )
        } else if bytes.get(128..132) == Some(b"DICM") {
            as_is("a DICOM picture", "convert it with `dcmj2pnm --write-png IN OUT.png` (DCMTK)")
        } else if bytes.starts_with(b"\0\0\x01\0") && bytes.get(4..6) != Some(&[0, 0]) {
            as_is("an ICO icon", MAGICK)
        } else if bytes.starts_with(b"\0\0\x02\0") && bytes.get(4..6) != Some(&[0, 0]) {
            as_is("a CUR cursor", MAGICK)
        } else if is_tga(bytes) {
            as_is("a TGA picture", CONVERT)
        } else if is_pcx(bytes) {
            as_is("a PCX picture", CONVERT)
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

/// The major brand of an ISO base media file.
fn iso_brand(bytes: &[u8]) -> Option<&[u8; 4]> {
    match bytes {
        [0, 0, _, _, b'f', b't', b'y', b'p', rest @ ..] => rest.first_chunk(),
        [0, 0, 0, 12, b'J', b'X', b'L', b' ', ..] => Some(b"jxl "),
        [0, 0, 0, 12, b'j', b'P', b' ', b' ', ..] => Some(b"jp2 "),
        _ => None,
    }
}

/// TGA has no magic number; its header has few values that are possible.
fn is_tga(bytes: &[u8]) -> bool {
    let Some(&header) = bytes.first_chunk::<18>() else { return false };
    let [_, has_palette, kind, .., depth, _] = header;
    let is_kind = match kind {
        1 | 9 => has_palette == 1,
        2 | 3 | 10 | 11 => has_palette == 0 && header[3..8] == [0; 5],
        _ => false,
    };
    let has_pixels = header[12..14] != [0, 0] && header[14..16] != [0, 0];
    is_kind && has_pixels && matches!(depth, 8 | 15 | 16 | 24 | 32)
}

/// PCX has a magic number of one byte only.
fn is_pcx(bytes: &[u8]) -> bool {
    let is_header = |&[manufacturer, version, encoding, depth]: &[u8; 4]| {
        manufacturer == 10 && version <= 5 && encoding == 1 && matches!(depth, 1 | 2 | 4 | 8)
    };
    bytes.len() >= 128 && bytes.first_chunk().is_some_and(is_header)
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
            (b"\0\0\x01\0\x01\0\x20\x20", "ICO", "magick"),
            (b"\0\0\x02\0\x01\0\x20\x20", "CUR", "magick"),
            (b"\0\0\x02\0\0\0\0\0\0\0\0\0\x40\0\x30\0\x18\0", "TGA", "ffmpeg"),
            (b"\x05\x01\x09\0\0\0\x01\x18\0\0\0\0\x40\0\x30\0\x08\0", "TGA", "ffmpeg"),
            (b"8BPS\0\x01", "PSD", "PNG"),
            (b"qoif\0\0\0\x02", "QOI", "ffmpeg"),
            (b"DDS |\0\0\0", "DDS", "ffmpeg"),
            (b"II\xBC\x01", "JPEG XR", "JxrDecApp"),
            (b"\x93NUMPY\x01\0", "NumPy", "PNG"),
            (b"#ROSBAG V2.0\n", "ROS bag", "export"),
            (b"/9j/4AAQSkZJRg", "base64", "decode"),
            (b"data:image/png;base64,iVBOR", "data URL", "decode"),
            (b"\x0A\x05\x01\x08".repeat(40).as_slice(), "PCX", "ffmpeg"),
            ([&[b'a'; 257][..], b"ustar\0"].concat().as_slice(), "tar", "images:batch"),
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
        // None of them is a format that is read.
        for (magic, name, _) in MAGIC {
            let padded = [magic, &[0; 64]].concat();
            assert_eq!(MediaType::sniff(&padded).filter(|_| !name.contains("raw")), None, "{name}");
        }
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
