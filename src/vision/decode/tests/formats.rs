//! The formats of robots, industrial cameras and phones, at every depth.

use super::*;
use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb};

/// A picture with all 256 levels, like a scene: bright, dark and in between.
fn scene() -> RgbImage {
    RgbImage::from_fn(64, 48, |x, y| Rgb([(x * 4) as u8, (y * 5) as u8, ((x * y) % 256) as u8]))
}

fn write(picture: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn pixels(bytes: &[u8]) -> RgbImage {
    decode(bytes, LIMITS, Needed::All).unwrap_or_else(|error| panic!("{error}")).pixels
}

fn furthest(a: &RgbImage, b: &RgbImage) -> u8 {
    assert_eq!(a.dimensions(), b.dimensions());
    a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

/// An uncompressed TIFF with one strip and further tags, each a short.
fn tiff(size: (u16, u16), bits: u16, samples: u16, data: &[u8], more: &[(u16, u16)]) -> Vec<u8> {
    let mut tags: Vec<(u16, u16, u32)> = vec![
        (256, 3, size.0.into()),
        (257, 3, size.1.into()),
        (258, 3, bits.into()),
        (259, 3, 1),
        (262, 3, if samples == 1 { 1 } else { 2 }),
        (273, 4, 8),
        (277, 3, samples.into()),
        (278, 3, size.1.into()),
        (279, 4, data.len() as u32),
    ];
    for &(tag, value) in more {
        tags.retain(|(name, ..)| *name != tag);
        tags.push((tag, 3, value.into()));
    }
    tags.sort_unstable();
    let mut bytes = b"II*\0".to_vec();
    bytes.extend((8 + data.len() as u32).to_le_bytes());
    bytes.extend(data);
    bytes.extend((tags.len() as u16).to_le_bytes());
    for (tag, kind, value) in tags {
        bytes.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
        bytes.extend([1u32.to_le_bytes(), value.to_le_bytes()].concat());
    }
    bytes.extend([0; 4]);
    bytes
}

#[test]
fn lossless_formats_give_the_same_pixels() {
    let scene = scene();
    let picture = DynamicImage::ImageRgb8(scene.clone());
    let raw = scene.as_raw();
    let ascii: Vec<String> = raw.iter().map(u8::to_string).collect();
    let ascii = format!("P3\n# a comment\n64 48\n255\n{}\n", ascii.join(" ")).into_bytes();
    let pam = b"P7\nWIDTH 64\nHEIGHT 48\nDEPTH 3\nMAXVAL 255\nTUPLTYPE RGB\nENDHDR\n".as_slice();
    for (name, bytes, media_type) in [
        ("PNG", write(&picture, ImageFormat::Png), MediaType::Png),
        ("BMP", write(&picture, ImageFormat::Bmp), MediaType::Bmp),
        ("TIFF", write(&picture, ImageFormat::Tiff), MediaType::Tiff),
        ("PPM", [b"P6\n64 48\n255\n".as_slice(), raw].concat(), MediaType::Pnm),
        ("ASCII PPM", ascii, MediaType::Pnm),
        ("PAM", [pam, raw].concat(), MediaType::Pnm),
        ("WebP", write(&picture, ImageFormat::WebP), MediaType::Webp),
    ] {
        let decoded = decode(&bytes, LIMITS, Needed::All).unwrap();
        assert_eq!(decoded.pixels, scene, "{name}");
        assert_eq!((decoded.media_type, decoded.warnings.len()), (media_type, 0), "{name}");
    }
}

#[test]
fn grey_bitmap_and_transparent_pictures_are_decoded() {
    let scene = DynamicImage::ImageRgb8(scene());
    let grey = scene.to_luma8();
    let expected = DynamicImage::ImageLuma8(grey.clone()).into_rgb8();
    let ascii: Vec<String> = grey.as_raw().iter().map(u8::to_string).collect();
    let with_alpha: Vec<u8> = grey.as_raw().iter().flat_map(|&value| [value, 255]).collect();
    let pam = "P7\nWIDTH 64\nHEIGHT 48\nDEPTH 2\nMAXVAL 255\nTUPLTYPE GRAYSCALE_ALPHA\nENDHDR\n";
    for (name, bytes) in [
        ("PGM", [b"P5\n64 48\n255\n".as_slice(), grey.as_raw()].concat()),
        ("ASCII PGM", format!("P2 64 48 255 {}", ascii.join("\n")).into_bytes()),
        ("PAM with alpha", [pam.as_bytes(), &with_alpha].concat()),
        ("PNG", write(&DynamicImage::ImageLuma8(grey.clone()), ImageFormat::Png)),
        (
            "PNG with alpha",
            write(&DynamicImage::ImageLumaA8(scene.to_luma_alpha8()), ImageFormat::Png),
        ),
        ("TIFF", write(&DynamicImage::ImageLuma8(grey.clone()), ImageFormat::Tiff)),
    ] {
        assert_eq!(pixels(&bytes), expected, "{name}");
    }
    let bits: Vec<u8> = (0..48).flat_map(|_| [0xF0; 8]).collect();
    let bitmap = pixels(&[b"P4\n64 48\n".as_slice(), &bits].concat());
    assert_eq!((bitmap.get_pixel(0, 0).0, bitmap.get_pixel(4, 9).0), ([0; 3], [255; 3]));
    let ascii = pixels(b"P1\n2 1\n1 0\n");
    assert_eq!(ascii.as_raw(), &[0, 0, 0, 255, 255, 255]);
    let gif = pixels(&write(&scene, ImageFormat::Gif));
    assert!(gif.dimensions() == (64, 48) && furthest(&gif, &scene.into_rgb8()) < 64);
}

#[test]
fn ten_and_twelve_bits_look_like_eight() {
    let scene = DynamicImage::ImageRgb8(scene());
    let (colour, grey) = (scene.to_rgb8(), DynamicImage::ImageLuma8(scene.to_luma8()).into_rgb8());
    for bits in [8, 10, 12, 14, 16] {
        let deep = |value: u8| (u32::from(value) * ((1 << bits) - 1) / 255) as u16;
        let colour16 = ImageBuffer::<Rgb<u16>, Vec<u16>>::from_fn(64, 48, |x, y| {
            Rgb(colour.get_pixel(x, y).0.map(deep))
        });
        let grey16 = ImageBuffer::<Luma<u16>, Vec<u16>>::from_fn(64, 48, |x, y| {
            Luma([deep(grey.get_pixel(x, y)[0])])
        });
        let big_endian: Vec<u8> = grey16.as_raw().iter().flat_map(|v| v.to_be_bytes()).collect();
        let pgm = |max: u32| [format!("P5 64 48 {max}\n").as_bytes(), &big_endian].concat();
        let (colour16, grey16) =
            (DynamicImage::ImageRgb16(colour16), DynamicImage::ImageLuma16(grey16));
        for (name, bytes, expected) in [
            ("PNG", write(&grey16, ImageFormat::Png), &grey),
            ("TIFF", write(&grey16, ImageFormat::Tiff), &grey),
            ("colour PNG", write(&colour16, ImageFormat::Png), &colour),
            ("colour TIFF", write(&colour16, ImageFormat::Tiff), &colour),
            ("PGM of OpenCV", pgm(65535), &grey),
        ] {
            assert!(furthest(&pixels(&bytes), expected) <= 1, "{name} of {bits} bits");
        }
        if bits > 8 {
            assert!(furthest(&pixels(&pgm((1 << bits) - 1)), &grey) <= 1, "PGM of {bits} bits");
        }
    }
    // A dark picture whose header says what white is stays dark.
    let dark: Vec<u8> = (0..64u16 * 48).flat_map(|at| (at % 200).to_be_bytes()).collect();
    let dark = pixels(&[b"P5\n64 48\n4095\n".as_slice(), &dark].concat());
    assert!(dark.as_raw().iter().all(|&value| value <= 13));
}

#[test]
fn the_orientation_of_a_tiff_is_applied() {
    let grey: Vec<u8> = (0..6).map(|at| at * 40).collect();
    let upright = pixels(&tiff((3, 2), 8, 1, &grey, &[]));
    let turned = pixels(&tiff((3, 2), 8, 1, &grey, &[(274, 6)]));
    assert_eq!((upright.dimensions(), turned.dimensions()), ((3, 2), (2, 3)));
    assert_eq!(turned.get_pixel(1, 0), upright.get_pixel(0, 0));
    let needed = decode(&tiff((3, 2), 8, 1, &grey, &[(274, 8)]), LIMITS, Needed::All).unwrap();
    assert_eq!((needed.width, needed.height), (2, 3));
}

#[test]
fn a_kind_of_tiff_that_is_not_read_says_what_to_do() {
    for (bits, more) in [(32, &[(339, 1)][..]), (64, &[]), (8, &[(262, 3)])] {
        let error =
            decode(&tiff((2, 2), bits, 1, &[0; 64], more), LIMITS, Needed::All).unwrap_err();
        assert!(error.to_string().contains("PNG"), "{bits}: {error}");
    }
}

#[test]
fn the_smallest_pictures_are_decoded_and_empty_ones_refused() {
    for (width, height) in [(1, 1), (2, 2), (1, 7)] {
        let small = DynamicImage::ImageRgb8(gradient(width, height));
        for format in [
            ImageFormat::Jpeg,
            ImageFormat::Png,
            ImageFormat::Bmp,
            ImageFormat::Gif,
            ImageFormat::Tiff,
        ] {
            assert_eq!(pixels(&write(&small, format)).dimensions(), (width, height), "{format:?}");
        }
    }
    let bitmap = [b"BM".as_slice(), &[0; 12], &[40, 0, 0, 0], &[0; 8], &[1, 0, 24, 0], &[0; 24]];
    for (name, bytes) in [
        ("PGM", b"P5 0 4 255\n".to_vec()),
        ("PPM", b"P6\n4 0\n255\n".to_vec()),
        ("BMP", bitmap.concat()),
        ("GIF", b"GIF89a\0\0\0\0\0\0\0;".to_vec()),
        ("TIFF", tiff((0, 3), 8, 1, &[0; 8], &[])),
    ] {
        assert!(decode(&bytes, LIMITS, Needed::All).is_err(), "{name}");
    }
}

#[test]
fn a_huge_size_is_rejected_in_every_format() {
    let bitmap = |edge: u32| {
        let edges = [edge.to_le_bytes(), edge.to_le_bytes()].concat();
        [b"BM".as_slice(), &[0; 12], &[40, 0, 0, 0], &edges, &[1, 0, 24, 0], &[0; 24], &[0; 64]]
            .concat()
    };
    for (name, bytes) in [
        ("PPM", b"P6\n100000 100000\n255\n\0\0\0".to_vec()),
        ("PBM", b"P4\n100000 100000\n\0\0\0".to_vec()),
        ("BMP", bitmap(60_000)),
        (
            "GIF",
            b"GIF89a\xFF\xFF\xFF\xFF\0\0\0\x2C\0\0\0\0\xFF\xFF\xFF\xFF\0\x02\x02\x4C\x01\0;"
                .to_vec(),
        ),
        ("TIFF", tiff((65_000, 65_000), 16, 1, &[0; 64], &[])),
    ] {
        let error = decode(&bytes, LIMITS, Needed::All).unwrap_err();
        assert!(matches!(error, DecodeError::TooManyPixels { .. }), "{name}: {error}");
    }
}

#[test]
fn truncated_and_corrupt_files_end_in_a_picture_or_an_error() {
    let picture = DynamicImage::ImageRgb8(gradient(24, 16));
    let formats = [ImageFormat::Bmp, ImageFormat::Gif, ImageFormat::Tiff, ImageFormat::Pnm];
    for format in formats {
        let whole = write(&picture, format);
        for keep in [0, 3, 12, whole.len() / 4, whole.len() / 2, whole.len() - 20] {
            let cut = decode(&whole[..keep], LIMITS, Needed::All);
            assert!(cut.is_err(), "{format:?} cut at {keep}");
        }
        for at in 0..whole.len().min(600) {
            for change in [0x01, 0x55, 0xFF] {
                let mut bytes = whole.clone();
                bytes[at] ^= change;
                if let Ok(picture) = decode(&bytes, LIMITS, Needed::Size(10, 5)) {
                    let pixels = u64::from(picture.width) * u64::from(picture.height);
                    assert!(pixels <= LIMITS.max_pixels, "{format:?}, byte {at}");
                }
            }
        }
    }
}
