//! Decoding of untrusted bytes to pixels.

use std::io::Cursor;

use image::{DynamicImage, ImageDecoder, ImageReader, Limits, RgbImage};

use super::jpeg::{self, Malformed, Outline};
use whereabouts_core::MediaType;

/// Limits on a picture, checked before its pixels are decoded.
#[derive(Debug, Clone, Copy)]
pub struct ImageLimits {
    /// Maximum pixels (width × height).
    pub max_pixels: u64,
}

/// A decoded picture, upright.
#[derive(Debug, Clone)]
pub struct Picture {
    /// The pixels, with the EXIF orientation applied; at a reduced resolution if [`Needed`] allows it.
    pub pixels: RgbImage,
    /// Width of the picture in the file in pixels, upright.
    pub width: u32,
    /// Height of the picture in the file in pixels, upright.
    pub height: u32,
    /// Format of the file.
    pub media_type: MediaType,
}

/// The resolution that the caller needs. A JPEG with at least twice that resolution is decoded at a half, a quarter
/// or an eighth of its size, which takes a fraction of the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Needed {
    /// Full resolution.
    All,
    /// At least this width and height, upright.
    Size(u32, u32),
    /// A longer edge of at least this length.
    LongestEdge(u32),
}

/// Why bytes cannot be decoded.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The magic bytes are not those of JPEG, PNG or WebP.
    #[error("the bytes are not a JPEG, PNG or WebP picture; send one of these formats")]
    UnknownFormat,
    /// The picture exceeds the configured limit.
    #[error(
        "the picture has {width}×{height} pixels, more than the {max_pixels} that this server \
         decodes (image.max_pixels); scale it down before sending"
    )]
    TooManyPixels {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// The limit.
        max_pixels: u64,
    },
    /// The file is truncated.
    #[error("the JPEG is truncated: its data ends before the end-of-image marker; send it whole")]
    Truncated,
    /// The decoder failed.
    #[error("the {format} cannot be decoded: {reason}")]
    Damaged {
        /// Format by the magic bytes.
        format: &'static str,
        /// Message of the decoder.
        reason: String,
    },
}

/// Decodes a JPEG, PNG or WebP picture to upright RGB.
///
/// The size is checked in the header first, so that a small file that claims a huge picture is rejected at no cost.
pub fn decode(bytes: &[u8], limits: ImageLimits, needed: Needed) -> Result<Picture, DecodeError> {
    match MediaType::sniff(bytes).ok_or(DecodeError::UnknownFormat)? {
        MediaType::Jpeg => decode_jpeg(bytes, limits, needed),
        MediaType::Png => decode_whole(bytes, limits, MediaType::Png),
        MediaType::Webp => decode_whole(bytes, limits, MediaType::Webp),
    }
}

fn decode_jpeg(bytes: &[u8], limits: ImageLimits, needed: Needed) -> Result<Picture, DecodeError> {
    let damaged = |reason: &str| DecodeError::Damaged { format: "JPEG", reason: reason.to_owned() };
    let outline = Outline::read(bytes).map_err(|malformed| match malformed {
        Malformed::Truncated => DecodeError::Truncated,
        Malformed::NoFrame => damaged("it has no frame header"),
        Malformed::TooManyScans => damaged("it has too many scans; save it as a baseline JPEG"),
    })?;
    within(limits, outline.width, outline.height)?;
    if !matches!(outline.components, 1 | 3) {
        // CMYK, which libjpeg-turbo does not convert to RGB.
        return decode_whole(bytes, limits, MediaType::Jpeg);
    }
    let (width, height) = outline.upright();
    let pixels = jpeg::decode(bytes, outline, needed.eighths(width, height))
        .map_err(|reason| damaged(&reason))?;
    let mut pixels = DynamicImage::ImageRgb8(pixels);
    pixels.apply_orientation(outline.orientation);
    Ok(Picture { pixels: pixels.into_rgb8(), width, height, media_type: MediaType::Jpeg })
}

fn decode_whole(
    bytes: &[u8],
    limits: ImageLimits,
    media_type: MediaType,
) -> Result<Picture, DecodeError> {
    let (format, name) = match media_type {
        MediaType::Jpeg => (image::ImageFormat::Jpeg, "JPEG"),
        MediaType::Png => (image::ImageFormat::Png, "PNG"),
        MediaType::Webp => (image::ImageFormat::WebP, "WebP"),
    };
    let damaged =
        |error: image::ImageError| DecodeError::Damaged { format: name, reason: error.to_string() };
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(allocation_limits(limits));
    let mut decoder = reader.into_decoder().map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    within(limits, width, height)?;
    let orientation = decoder.orientation().map_err(damaged)?;
    let mut pixels = DynamicImage::from_decoder(decoder).map_err(damaged)?;
    pixels.apply_orientation(orientation);
    let pixels = pixels.into_rgb8();
    let (width, height) = pixels.dimensions();
    Ok(Picture { pixels, width, height, media_type })
}

fn within(limits: ImageLimits, width: u32, height: u32) -> Result<(), DecodeError> {
    let max_pixels = limits.max_pixels;
    if u64::from(width) * u64::from(height) > max_pixels {
        return Err(DecodeError::TooManyPixels { width, height, max_pixels });
    }
    Ok(())
}

impl Needed {
    /// The smallest of 1, 2, 4 and 8 eighths that gives the needed resolution.
    fn eighths(self, width: u32, height: u32) -> u8 {
        let enough = |eighths: &u8| {
            let at_least = |edge: u32, needed: u32| {
                u64::from(edge) * u64::from(*eighths) >= 8 * u64::from(needed)
            };
            match self {
                Self::All => false,
                Self::Size(w, h) => at_least(width, w) && at_least(height, h),
                Self::LongestEdge(edge) => at_least(width.max(height), edge),
            }
        };
        [1, 2, 4].into_iter().find(enough).unwrap_or(8)
    }
}

/// Encodes a picture as JPEG, for display.
pub fn encode_jpeg(pixels: &RgbImage) -> Result<Vec<u8>, DecodeError> {
    const QUALITY: u8 = 85;
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, QUALITY)
        .encode_image(pixels)
        .map_err(|error| DecodeError::Damaged { format: "JPEG", reason: error.to_string() })?;
    Ok(bytes)
}

/// Memory that the decoder may allocate: 8 bytes per pixel for 16-bit RGBA, and the same again for working memory.
fn allocation_limits(limits: ImageLimits) -> Limits {
    let mut allowed = Limits::default();
    allowed.max_alloc = Some(limits.max_pixels.saturating_mul(16).max(1 << 20));
    allowed
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ExtendedColorType, ImageEncoder};

    const LIMITS: ImageLimits = ImageLimits { max_pixels: 1_000_000 };

    fn gradient(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            image::Rgb([(x * 5) as u8, (y * 7) as u8, ((x + y) * 3) as u8])
        })
    }

    fn encode(format: image::ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        gradient(40, 20).write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    /// A JPEG whose EXIF block has only the orientation tag.
    fn with_orientation(orientation: u8) -> Vec<u8> {
        let exif = [
            b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".as_slice(),
            &[orientation, 0, 0, 0, 0, 0, 0, 0],
        ]
        .concat();
        let mut bytes = Vec::new();
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95);
        encoder.set_exif_metadata(exif).unwrap();
        encoder.write_image(gradient(40, 20).as_raw(), 40, 20, ExtendedColorType::Rgb8).unwrap();
        bytes
    }

    #[test]
    fn all_three_formats_are_decoded() {
        for format in [image::ImageFormat::Jpeg, image::ImageFormat::Png, image::ImageFormat::WebP]
        {
            let picture = decode(&encode(format), LIMITS, Needed::All).unwrap();
            assert_eq!(picture.pixels.dimensions(), (40, 20), "{format:?}");
        }
    }

    #[test]
    fn the_exif_orientation_is_applied() {
        let plain = decode(&with_orientation(1), LIMITS, Needed::All).unwrap().pixels;
        let turned = decode(&with_orientation(6), LIMITS, Needed::All).unwrap().pixels;
        assert_eq!(turned.dimensions(), (20, 40));
        assert_eq!(turned.get_pixel(19, 0), plain.get_pixel(0, 0));
    }

    #[test]
    fn a_large_jpeg_is_reduced_to_the_needed_resolution() {
        let mut jpeg = Vec::new();
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95);
        encoder.encode_image(&gradient(401, 200)).unwrap();
        for (needed, expected) in [
            (Needed::All, (401, 200)),
            (Needed::Size(201, 100), (401, 200)),
            (Needed::Size(200, 100), (201, 100)),
            (Needed::Size(20, 50), (101, 50)),
            (Needed::LongestEdge(50), (51, 25)),
            (Needed::LongestEdge(4000), (401, 200)),
        ] {
            let picture = decode(&jpeg, LIMITS, needed).unwrap();
            assert_eq!(picture.pixels.dimensions(), expected, "{needed:?}");
            assert_eq!((picture.width, picture.height), (401, 200));
        }
        let turned = decode(&with_orientation(6), LIMITS, Needed::Size(10, 20)).unwrap();
        assert_eq!(turned.pixels.dimensions(), (10, 20));
        assert_eq!((turned.width, turned.height), (20, 40));
    }

    #[test]
    fn a_reduced_picture_is_an_area_average() {
        let mut jpeg = Vec::new();
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 100);
        let smooth = RgbImage::from_fn(320, 160, |x, y| {
            image::Rgb([(x / 2) as u8, y as u8, ((x + y) / 4) as u8])
        });
        encoder.encode_image(&smooth).unwrap();
        let whole = decode(&jpeg, LIMITS, Needed::All).unwrap().pixels;
        let half = decode(&jpeg, LIMITS, Needed::Size(160, 80)).unwrap().pixels;
        for (x, y, pixel) in half.enumerate_pixels() {
            for channel in 0..3 {
                let at = |dx, dy| i32::from(whole.get_pixel(2 * x + dx, 2 * y + dy)[channel]);
                let mean = (at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1)) / 4;
                assert!((i32::from(pixel[channel]) - mean).abs() <= 3, "{x} {y}");
            }
        }
    }

    #[test]
    fn contradicting_frame_headers_are_rejected() {
        let mut bytes = encode(image::ImageFormat::Jpeg);
        let frame = bytes.windows(2).position(|pair| pair == [0xFF, 0xC0]).unwrap();
        // A second frame header, with a small size, before the real one.
        let mut small = bytes[frame..frame + 19].to_vec();
        small[5..9].copy_from_slice(&[0, 8, 0, 8]);
        bytes.splice(frame..frame, small);
        assert!(matches!(decode(&bytes, LIMITS, Needed::All), Err(DecodeError::Damaged { .. })));
    }

    #[test]
    fn a_file_with_too_many_scans_is_rejected_before_decoding() {
        let mut bytes = encode(image::ImageFormat::Jpeg);
        let scan = bytes.windows(2).position(|pair| pair == [0xFF, 0xDA]).unwrap();
        let header = bytes[scan..scan + 14].to_vec();
        bytes.splice(scan..scan, header.repeat(1000));
        let error = decode(&bytes, LIMITS, Needed::All).unwrap_err().to_string();
        assert!(error.contains("too many scans"), "{error}");
    }

    #[test]
    fn every_corrupted_byte_yields_a_picture_or_an_error() {
        let whole = encode(image::ImageFormat::Jpeg);
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x55;
            if let Ok(picture) = decode(&bytes, LIMITS, Needed::Size(10, 5)) {
                let pixels = u64::from(picture.width) * u64::from(picture.height);
                assert!(pixels <= LIMITS.max_pixels, "byte {at}");
            }
        }
    }

    #[test]
    fn a_truncated_file_is_rejected() {
        for format in [image::ImageFormat::Jpeg, image::ImageFormat::Png, image::ImageFormat::WebP]
        {
            let whole = encode(format);
            for keep in [12, whole.len() / 4, whole.len() / 2, whole.len() - 20] {
                assert!(
                    decode(&whole[..keep], LIMITS, Needed::All).is_err(),
                    "{format:?} cut at {keep}"
                );
            }
        }
    }

    #[test]
    fn a_huge_picture_is_rejected_by_its_header() {
        let tight = ImageLimits { max_pixels: 799 };
        let error = decode(&encode(image::ImageFormat::Png), tight, Needed::All).unwrap_err();
        assert!(matches!(error, DecodeError::TooManyPixels { width: 40, height: 20, .. }));
    }

    #[test]
    fn text_is_rejected() {
        assert!(matches!(
            decode(b"hello, robot", LIMITS, Needed::All),
            Err(DecodeError::UnknownFormat)
        ));
    }
}
