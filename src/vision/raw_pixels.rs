//! Pixels without a file format, as a camera driver delivers them, wrapped as PNG so that every later stage reads
//! them like any other picture.

use std::fmt;
use std::str::FromStr;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::ImageLimits;
use whereabouts_core::MediaType;

/// The layout of a pixel, by the names of ROS (`sensor_msgs/image_encodings.hpp`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelEncoding {
    /// One byte of grey.
    Mono8,
    /// Two bytes of grey, the less significant first.
    Mono16,
    /// Red, green, blue.
    Rgb8,
    /// Blue, green, red.
    Bgr8,
    /// Red, green, blue, and an alpha that is ignored.
    Rgba8,
    /// Blue, green, red, and an alpha that is ignored.
    Bgra8,
}

impl PixelEncoding {
    /// Bytes of one pixel.
    fn bytes(self) -> u64 {
        match self {
            Self::Mono8 => 1,
            Self::Mono16 => 2,
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::Rgba8 | Self::Bgra8 => 4,
        }
    }

    /// The name in the API.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Mono8 => "mono8",
            Self::Mono16 => "mono16",
            Self::Rgb8 => "rgb8",
            Self::Bgr8 => "bgr8",
            Self::Rgba8 => "rgba8",
            Self::Bgra8 => "bgra8",
        }
    }
}

impl fmt::Display for PixelEncoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for PixelEncoding {
    type Err = RawPixelsError;

    fn from_str(text: &str) -> Result<Self, RawPixelsError> {
        Ok(match text {
            "mono8" | "8UC1" => Self::Mono8,
            "mono16" => Self::Mono16,
            "rgb8" => Self::Rgb8,
            // OpenCV's order, which drivers of this encoding use.
            "bgr8" | "8UC3" => Self::Bgr8,
            "rgba8" => Self::Rgba8,
            "bgra8" | "8UC4" => Self::Bgra8,
            _ => return Err(RawPixelsError::Encoding(text.chars().take(40).collect())),
        })
    }
}

/// The layout of a picture without a file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawPixels {
    /// The layout of a pixel.
    pub encoding: PixelEncoding,
    /// Pixels in a row.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
    /// Bytes from the start of one row to that of the next; by default the bytes of a row.
    pub step: Option<u64>,
}

/// Why pixels cannot be read.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum RawPixelsError {
    /// The encoding is unknown.
    #[error(
        "the encoding {0:?} is not one of mono8, mono16, rgb8, bgr8, rgba8, bgra8; convert the picture (in ROS with \
         image_proc or cv_bridge), or send it as JPEG or PNG"
    )]
    Encoding(String),
    /// The picture has no pixels, or too many.
    #[error(
        "the picture has {width}×{height} pixels; this server reads 1 to {max_pixels} (image.max_pixels)"
    )]
    Size {
        /// Pixels in a row.
        width: u32,
        /// Number of rows.
        height: u32,
        /// The limit.
        max_pixels: u64,
    },
    /// The rows overlap.
    #[error("step is {step}, but a row of {width} {encoding} pixels has {row} bytes")]
    Step {
        /// Bytes from row to row.
        step: u64,
        /// Pixels in a row.
        width: u32,
        /// The layout of a pixel.
        encoding: PixelEncoding,
        /// Bytes of a row.
        row: u64,
    },
    /// The number of bytes differs from what the size needs.
    #[error(
        "the body has {bytes} bytes, but {width}×{height} {encoding} pixels in rows of {step} bytes are {expected}; \
         check width, height, encoding and step{hint}"
    )]
    Bytes {
        /// Bytes that were sent.
        bytes: usize,
        /// Pixels in a row.
        width: u32,
        /// Number of rows.
        height: u32,
        /// The layout of a pixel.
        encoding: PixelEncoding,
        /// Bytes from row to row.
        step: u64,
        /// Bytes that the size needs.
        expected: u64,
        /// What else to try.
        hint: &'static str,
    },
    /// The encoder failed.
    #[error("the pixels cannot be stored as PNG: {0}")]
    Encode(String),
}

impl RawPixels {
    /// Checks that `bytes` have exactly the size of the picture, and returns the picture as PNG.
    pub fn to_png(self, bytes: &[u8], limits: ImageLimits) -> Result<Vec<u8>, RawPixelsError> {
        let Self { encoding, width, height, .. } = self;
        let max_pixels = limits.max_pixels;
        let pixels = u64::from(width) * u64::from(height);
        if pixels == 0 || pixels > max_pixels {
            return Err(RawPixelsError::Size { width, height, max_pixels });
        }
        let row = u64::from(width) * encoding.bytes();
        let step = self.step.unwrap_or(row);
        if step < row {
            return Err(RawPixelsError::Step { step, width, encoding, row });
        }
        let expected = step.saturating_mul(u64::from(height));
        if bytes.len() as u64 != expected {
            let hint = match MediaType::sniff(bytes) {
                Some(_) => ", or leave them out: the body looks like a picture file",
                None => "",
            };
            let bytes = bytes.len();
            return Err(RawPixelsError::Bytes {
                bytes,
                width,
                height,
                encoding,
                step,
                expected,
                hint,
            });
        }
        // Both fit, because the rows are in memory.
        let rows = bytes.chunks_exact(step as usize).map(|line| &line[..row as usize]);
        let mut samples = Vec::with_capacity((row * u64::from(height)) as usize);
        for row in rows {
            append(encoding, row, &mut samples);
        }
        let color = match encoding {
            PixelEncoding::Mono8 => ExtendedColorType::L8,
            PixelEncoding::Mono16 => ExtendedColorType::L16,
            _ => ExtendedColorType::Rgb8,
        };
        let mut png = Vec::new();
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Up)
            .write_image(&samples, width, height, color)
            .map_err(|error| RawPixelsError::Encode(error.to_string()))?;
        Ok(png)
    }
}

/// Appends a row as the samples of a PNG: grey, or red, green and blue.
fn append(encoding: PixelEncoding, row: &[u8], samples: &mut Vec<u8>) {
    match encoding {
        PixelEncoding::Mono8 | PixelEncoding::Rgb8 => samples.extend_from_slice(row),
        // The encoder takes samples in the order of this machine.
        PixelEncoding::Mono16 => samples.extend(
            row.as_chunks::<2>().0.iter().flat_map(|pair| u16::from_le_bytes(*pair).to_ne_bytes()),
        ),
        PixelEncoding::Bgr8 => {
            samples.extend(row.as_chunks::<3>().0.iter().flat_map(|&[b, g, r]| [r, g, b]));
        }
        PixelEncoding::Rgba8 => {
            samples.extend(row.as_chunks::<4>().0.iter().flat_map(|&[r, g, b, _]| [r, g, b]));
        }
        PixelEncoding::Bgra8 => {
            samples.extend(row.as_chunks::<4>().0.iter().flat_map(|&[b, g, r, _]| [r, g, b]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::{Needed, decode};

    const LIMITS: ImageLimits = ImageLimits { max_pixels: 100 };

    fn raw(encoding: PixelEncoding, width: u32, height: u32, step: Option<u64>) -> RawPixels {
        RawPixels { encoding, width, height, step }
    }

    fn pixels(raw: RawPixels, bytes: &[u8]) -> Vec<[u8; 3]> {
        let png = raw.to_png(bytes, LIMITS).unwrap();
        let picture = decode(&png, LIMITS, Needed::All).unwrap();
        assert_eq!((picture.width, picture.height), (raw.width, raw.height));
        picture.pixels.pixels().map(|pixel| pixel.0).collect()
    }

    #[test]
    fn every_encoding_gives_the_same_pixels() {
        let expected = [[10, 20, 30], [40, 50, 60]];
        for (encoding, bytes) in [
            (PixelEncoding::Rgb8, &[10, 20, 30, 40, 50, 60][..]),
            (PixelEncoding::Bgr8, &[30, 20, 10, 60, 50, 40]),
            (PixelEncoding::Rgba8, &[10, 20, 30, 0, 40, 50, 60, 255]),
            (PixelEncoding::Bgra8, &[30, 20, 10, 0, 60, 50, 40, 255]),
        ] {
            assert_eq!(pixels(raw(encoding, 2, 1, None), bytes), expected, "{encoding}");
            assert_eq!(pixels(raw(encoding, 1, 2, None), bytes), expected, "{encoding}");
        }
        let grey = [[7, 7, 7], [200, 200, 200]];
        assert_eq!(pixels(raw(PixelEncoding::Mono8, 2, 1, None), &[7, 200]), grey);
    }

    #[test]
    fn sixteen_bits_of_grey_keep_their_order() {
        let png = raw(PixelEncoding::Mono16, 2, 1, None).to_png(&[0x34, 0x12, 0xFF, 0xFF], LIMITS);
        let picture = image::load_from_memory(&png.unwrap()).unwrap().into_luma16();
        assert_eq!(picture.into_raw(), [0x1234, 0xFFFF]);
    }

    #[test]
    fn padding_after_each_row_is_ignored() {
        let padded = [1, 2, 3, 99, 4, 5, 6, 99];
        let found = pixels(raw(PixelEncoding::Rgb8, 1, 2, Some(4)), &padded);
        assert_eq!(found, [[1, 2, 3], [4, 5, 6]]);
    }

    #[test]
    fn a_size_that_does_not_fit_the_bytes_is_refused() {
        let rgb = |width, height, step| raw(PixelEncoding::Rgb8, width, height, step);
        for (raw, bytes, word) in [
            (rgb(2, 1, None), 5, "are 6"),
            (rgb(2, 1, None), 7, "are 6"),
            (rgb(1, 2, Some(4)), 7, "are 8"),
            (rgb(2, 1, Some(5)), 5, "step is 5"),
            (rgb(0, 5, None), 0, "0×5"),
            (rgb(5, 0, None), 0, "5×0"),
            (rgb(11, 10, None), 330, "image.max_pixels"),
            (rgb(u32::MAX, u32::MAX, None), 0, "image.max_pixels"),
            (rgb(1, 2, Some(u64::MAX)), 6, "in rows of"),
        ] {
            let refused = raw.to_png(&vec![0; bytes], LIMITS).unwrap_err().to_string();
            assert!(refused.contains(word), "{raw:?}: {refused}");
        }
        let jpeg = rgb(2, 2, None).to_png(b"\xFF\xD8\xFF\xE0", LIMITS).unwrap_err().to_string();
        assert!(jpeg.contains("leave them out"), "{jpeg}");
    }

    #[test]
    fn encodings_have_the_names_of_ros() {
        for name in ["mono8", "mono16", "rgb8", "bgr8", "rgba8", "bgra8"] {
            assert_eq!(name.parse::<PixelEncoding>().unwrap().as_str(), name);
        }
        assert_eq!("8UC3".parse(), Ok(PixelEncoding::Bgr8));
        for name in ["", "yuv422", "bayer_rggb8", "32FC1", "16UC1", "RGB8"] {
            let refused = name.parse::<PixelEncoding>().unwrap_err().to_string();
            assert!(refused.contains("mono8, mono16, rgb8"), "{refused}");
        }
    }
}
