//! Bytes to pixels, for bytes that nobody vouches for.

use std::io::Cursor;

use image::{DynamicImage, ImageDecoder, ImageReader, Limits, RgbImage};

use super::jpeg;
use crate::domain::MediaType;

/// Bounds on a picture, checked before its pixels are decoded.
#[derive(Debug, Clone, Copy)]
pub struct ImageLimits {
    /// The most pixels (width × height) that are decoded.
    pub max_pixels: u64,
}

/// A decoded picture, upright.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Its pixels, turned as its EXIF orientation says.
    pub pixels: RgbImage,
    /// The format it came in.
    pub media_type: MediaType,
}

/// Why bytes could not become a picture.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The first bytes are not those of JPEG, PNG or WebP.
    #[error("the bytes are not a JPEG, PNG or WebP picture; send one of these formats")]
    UnknownFormat,
    /// The picture is larger than the configured bound.
    #[error(
        "the picture has {width}×{height} pixels, more than the {max_pixels} that this server \
         decodes (image.max_pixels); scale it down before sending"
    )]
    TooManyPixels {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// The bound.
        max_pixels: u64,
    },
    /// The file stops before its end.
    #[error("the JPEG is truncated: its data ends before the end-of-image marker; send it whole")]
    Truncated,
    /// The decoder gave up.
    #[error("the {format} cannot be decoded: {reason}")]
    Damaged {
        /// The format by its first bytes.
        format: &'static str,
        /// What the decoder said.
        reason: String,
    },
}

/// Decodes a JPEG, PNG or WebP picture to upright RGB.
///
/// The size is read from the header first, so that a small file that claims a huge picture costs
/// nothing.
pub fn decode(bytes: &[u8], limits: ImageLimits) -> Result<Picture, DecodeError> {
    let media_type = MediaType::sniff(bytes).ok_or(DecodeError::UnknownFormat)?;
    if media_type == MediaType::Jpeg && !jpeg::is_complete(bytes) {
        return Err(DecodeError::Truncated);
    }
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
    if u64::from(width) * u64::from(height) > limits.max_pixels {
        return Err(DecodeError::TooManyPixels { width, height, max_pixels: limits.max_pixels });
    }
    let orientation = decoder.orientation().map_err(damaged)?;
    let mut pixels = DynamicImage::from_decoder(decoder).map_err(damaged)?;
    pixels.apply_orientation(orientation);
    Ok(Picture { pixels: pixels.into_rgb8(), media_type })
}

/// Encodes a picture for people to look at.
pub fn encode_jpeg(pixels: &RgbImage) -> Result<Vec<u8>, DecodeError> {
    const QUALITY: u8 = 85;
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, QUALITY)
        .encode_image(pixels)
        .map_err(|error| DecodeError::Damaged { format: "JPEG", reason: error.to_string() })?;
    Ok(bytes)
}

/// What the decoder itself may allocate: 8 bytes a pixel hold 16-bit RGBA, and as much again is
/// left for its working memory.
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

    /// A TIFF block with the orientation tag alone, as cameras write it.
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
    fn the_three_formats_decode() {
        for format in [image::ImageFormat::Jpeg, image::ImageFormat::Png, image::ImageFormat::WebP]
        {
            let picture = decode(&encode(format), LIMITS).unwrap();
            assert_eq!(picture.pixels.dimensions(), (40, 20), "{format:?}");
        }
    }

    #[test]
    fn exif_orientation_turns_the_picture_upright() {
        let plain = decode(&with_orientation(1), LIMITS).unwrap().pixels;
        let turned = decode(&with_orientation(6), LIMITS).unwrap().pixels;
        assert_eq!(turned.dimensions(), (20, 40));
        assert_eq!(turned.get_pixel(19, 0), plain.get_pixel(0, 0));
    }

    #[test]
    fn a_file_cut_anywhere_is_refused() {
        for format in [image::ImageFormat::Jpeg, image::ImageFormat::Png, image::ImageFormat::WebP]
        {
            let whole = encode(format);
            for keep in [12, whole.len() / 4, whole.len() / 2, whole.len() - 20] {
                assert!(decode(&whole[..keep], LIMITS).is_err(), "{format:?} cut at {keep}");
            }
        }
    }

    #[test]
    fn a_huge_picture_is_refused_by_its_header() {
        let tight = ImageLimits { max_pixels: 799 };
        let error = decode(&encode(image::ImageFormat::Png), tight).unwrap_err();
        assert!(matches!(error, DecodeError::TooManyPixels { width: 40, height: 20, .. }));
    }

    #[test]
    fn text_is_no_picture() {
        assert!(matches!(decode(b"hello, robot", LIMITS), Err(DecodeError::UnknownFormat)));
    }
}
