//! Decoding of untrusted bytes to pixels.

mod depth;
mod foreign;
mod jpeg;

use std::io::Cursor;

use image::codecs::pnm::PnmDecoder;
use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits, RgbImage};

pub use self::foreign::Foreign;
use self::jpeg::{Decoded, Malformed, Outline};
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
    /// What the sender should know about the file although it was decoded.
    pub warnings: Vec<String>,
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
    /// The magic bytes are not those of a supported format.
    #[error("the bytes are not a picture of a known format; send {}", MediaType::NAMES)]
    UnknownFormat,
    /// The format was recognised, but the service does not read it.
    #[error("the file is {}, which the service does not read; {}", .0.name, .0.remedy)]
    Foreign(Foreign),
    /// The format is supported, but not this kind of it.
    #[error(
        "the {format} is of a kind that cannot be decoded ({reason}); save it with 8 or 16 bits in grey or RGB, or \
         as PNG"
    )]
    Unsupported {
        /// Format by the magic bytes.
        format: &'static str,
        /// Message of the decoder.
        reason: String,
    },
    /// The picture has no pixels.
    #[error("the {0} has no pixels; check what wrote it")]
    Empty(&'static str),
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
    #[error("the JPEG is truncated: its data ends before its last row; send it whole")]
    Truncated,
    /// The decoder failed.
    #[error(
        "the {format} cannot be decoded: {reason}; check that it arrived whole and send it again, or save it again \
         with another program"
    )]
    Damaged {
        /// Format by the magic bytes.
        format: &'static str,
        /// Message of the decoder.
        reason: String,
    },
}

/// Decodes a picture to upright RGB with 8 bits a sample.
///
/// The size is checked in the header first, so that a small file that claims a huge picture is rejected at no cost.
pub fn decode(bytes: &[u8], limits: ImageLimits, needed: Needed) -> Result<Picture, DecodeError> {
    if let Some(foreign) = Foreign::sniff(bytes) {
        return Err(DecodeError::Foreign(foreign));
    }
    match MediaType::sniff(bytes).ok_or(DecodeError::UnknownFormat)? {
        MediaType::Jpeg => decode_jpeg(bytes, limits, needed),
        MediaType::Tiff => match Foreign::in_tiff(bytes) {
            Some(raw) => Err(DecodeError::Foreign(raw)),
            None => decode_whole(bytes, limits, MediaType::Tiff),
        },
        other => decode_whole(bytes, limits, other),
    }
}

/// A truncated JPEG with at least this share of its rows is decoded, with a warning. Decoders fill the rest with
/// grey; a frame that was truncated in transit must not be localized by its upper half.
const ENOUGH_ROWS: f64 = 0.9;

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
    let with_end: Vec<u8>;
    let bytes = if outline.is_ended {
        bytes
    } else {
        // The decoder would warn of the missing marker as of missing data.
        with_end = [bytes, jpeg::END].concat();
        &with_end
    };
    let Decoded { pixels, intact } = jpeg::decode(bytes, outline, needed.eighths(width, height))
        .map_err(|reason| damaged(&reason))?;
    if !outline.is_ended && intact < ENOUGH_ROWS {
        return Err(DecodeError::Truncated);
    }
    let warnings = (intact < 1.0).then(|| damage(outline.is_ended)).into_iter().collect();
    let mut pixels = DynamicImage::ImageRgb8(pixels);
    pixels.apply_orientation(outline.orientation);
    let pixels = pixels.into_rgb8();
    Ok(Picture { pixels, width, height, media_type: MediaType::Jpeg, warnings })
}

fn damage(is_ended: bool) -> String {
    let what = match is_ended {
        true => "bytes in it are missing or changed, so a part of the picture is wrong",
        false => "its last rows are missing",
    };
    format!(
        "the JPEG is damaged: {what}, and the answer may be wrong too; check the transfer and send the picture again"
    )
}

fn decode_whole(
    bytes: &[u8],
    limits: ImageLimits,
    media_type: MediaType,
) -> Result<Picture, DecodeError> {
    let format = match media_type {
        MediaType::Jpeg => image::ImageFormat::Jpeg,
        MediaType::Png => image::ImageFormat::Png,
        MediaType::Webp => image::ImageFormat::WebP,
        MediaType::Pnm => image::ImageFormat::Pnm,
        MediaType::Tiff => image::ImageFormat::Tiff,
        MediaType::Bmp => image::ImageFormat::Bmp,
        MediaType::Gif => image::ImageFormat::Gif,
    };
    let name = media_type.name();
    let damaged = |error: ImageError| match error {
        ImageError::Unsupported(error) => {
            DecodeError::Unsupported { format: name, reason: error.to_string() }
        }
        error => DecodeError::Damaged { format: name, reason: error.to_string() },
    };
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(allocation_limits(limits));
    let mut decoder = reader.into_decoder().map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    within(limits, width, height)?;
    if width == 0 || height == 0 {
        return Err(DecodeError::Empty(name));
    }
    let orientation = decoder.orientation().map_err(damaged)?;
    let mut pixels = DynamicImage::from_decoder(decoder).map_err(damaged)?;
    pixels.apply_orientation(orientation);
    let is_full_scale = media_type == MediaType::Pnm && declares_its_maximum(bytes);
    let pixels = depth::to_rgb8(pixels, is_full_scale);
    let (width, height) = pixels.dimensions();
    Ok(Picture { pixels, width, height, media_type, warnings: Vec::new() })
}

/// Whether the header of a PNM file says how many bits are in use. Many writers always say 65535.
fn declares_its_maximum(bytes: &[u8]) -> bool {
    let decoder = PnmDecoder::new(Cursor::new(bytes));
    decoder.is_ok_and(|decoder| decoder.into_inner().1.maximal_sample() != u32::from(u16::MAX))
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
mod tests;
