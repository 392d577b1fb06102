//! Pictures of every format, whole, damaged and hostile.

mod damage;
mod formats;

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
    for format in [image::ImageFormat::Jpeg, image::ImageFormat::Png, image::ImageFormat::WebP] {
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
    for format in [image::ImageFormat::Jpeg, image::ImageFormat::Png, image::ImageFormat::WebP] {
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
fn a_format_that_is_not_read_is_named_with_a_way_to_convert_it() {
    let heic = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic";
    let error = decode(heic, LIMITS, Needed::All).unwrap_err().to_string();
    assert!(error.contains("HEIC") && error.contains("heif-convert"), "{error}");
}

#[test]
fn text_is_rejected() {
    assert!(matches!(
        decode(b"hello, robot", LIMITS, Needed::All),
        Err(DecodeError::UnknownFormat)
    ));
}
