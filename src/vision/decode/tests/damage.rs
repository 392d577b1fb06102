//! JPEGs as webcams and bad connections deliver them.

use super::*;

const SCENES: [&[u8]; 2] = [
    include_bytes!("../../samples/street-day.jpg"),
    include_bytes!("../../samples/street-night.jpg"),
];

fn scene() -> RgbImage {
    decode(SCENES[0], LIMITS, Needed::All).unwrap().pixels
}

/// Encodes with libjpeg: baseline with standard tables, or as `choose` wants.
fn jpeg(choose: impl FnOnce(&mut mozjpeg::Compress)) -> Vec<u8> {
    let scene = scene();
    let mut encoder = mozjpeg::Compress::new(mozjpeg::ColorSpace::JCS_RGB);
    encoder.set_fastest_defaults();
    encoder.set_size(scene.width() as usize, scene.height() as usize);
    encoder.set_quality(85.0);
    choose(&mut encoder);
    let mut started = encoder.start_compress(Vec::new()).unwrap();
    started.write_scanlines(scene.as_raw()).unwrap();
    started.finish().unwrap()
}

fn plain() -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 85);
    encoder.encode_image(&scene()).unwrap();
    bytes
}

/// Position of the first byte of entropy-coded data.
fn data_start(bytes: &[u8]) -> usize {
    let scan = bytes.windows(2).position(|pair| pair == [0xFF, 0xDA]).unwrap();
    scan + 2 + usize::from(u16::from_be_bytes([bytes[scan + 2], bytes[scan + 3]]))
}

fn warnings(bytes: &[u8]) -> Vec<String> {
    decode(bytes, LIMITS, Needed::All).unwrap().warnings
}

#[test]
fn intact_jpegs_of_every_kind_have_no_warning() {
    let mut kinds =
        vec![("plain", plain()), ("day", SCENES[0].to_vec()), ("night", SCENES[1].to_vec())];
    kinds.push(("baseline", jpeg(|_| ())));
    kinds.push(("optimised", jpeg(|encoder| encoder.set_optimize_coding(true))));
    kinds.push(("progressive", jpeg(|encoder| encoder.set_progressive_mode())));
    kinds.push(("4:4:4", jpeg(|encoder| encoder.set_chroma_sampling_pixel_sizes((1, 1), (1, 1)))));
    kinds.push(("4:2:0", jpeg(|encoder| encoder.set_chroma_sampling_pixel_sizes((2, 2), (2, 2)))));
    kinds.push(("low quality", jpeg(|encoder| encoder.set_quality(10.0))));
    for (name, bytes) in kinds {
        for needed in [Needed::All, Needed::LongestEdge(300), Needed::LongestEdge(60)] {
            let picture = decode(&bytes, LIMITS, needed).unwrap();
            assert_eq!(picture.warnings, Vec::<String>::new(), "{name}, {needed:?}");
        }
    }
}

#[test]
fn a_jpeg_that_only_misses_its_end_marker_is_taken() {
    for whole in [plain(), jpeg(|_| ()), jpeg(|encoder| encoder.set_progressive_mode())] {
        assert_eq!(whole[whole.len() - 2..], [0xFF, 0xD9]);
        let complete = decode(&whole, LIMITS, Needed::All).unwrap();
        for cut in [1, 2] {
            let picture = decode(&whole[..whole.len() - cut], LIMITS, Needed::All).unwrap();
            assert!(picture.pixels == complete.pixels && picture.warnings.is_empty(), "{cut}");
        }
    }
}

#[test]
fn a_jpeg_that_is_cut_within_its_picture_is_refused() {
    for whole in [plain(), jpeg(|encoder| encoder.set_progressive_mode())] {
        for share in [0.3, 0.5, 0.8] {
            let keep = (whole.len() as f64 * share) as usize;
            let error = decode(&whole[..keep], LIMITS, Needed::All).unwrap_err();
            assert!(matches!(error, DecodeError::Truncated), "{share}: {error}");
        }
    }
    // Only the last rows are missing.
    let whole = plain();
    let warned = warnings(&whole[..whole.len() - 40]);
    assert!(warned[0].contains("damaged") && warned[0].contains("last rows"), "{warned:?}");
}

/// Of 40 positions at which this many bytes are lost, the share that is refused or gets a warning.
fn noticed(whole: &[u8], lost: usize) -> f64 {
    let start = data_start(whole);
    let step = (whole.len() - start) / 40;
    let positions = (start + 10..whole.len() - lost - 10).step_by(step);
    let all = positions.clone().count() as f64;
    let noticed = positions.filter(|&at| {
        let bytes = [&whole[..at], &whole[at + lost..]].concat();
        decode(&bytes, LIMITS, Needed::All).map_or(true, |picture| !picture.warnings.is_empty())
    });
    noticed.count() as f64 / all
}

#[test]
fn a_jpeg_that_lost_bytes_in_the_middle_is_taken_with_a_warning() {
    let whole = plain();
    for lost in [64, 512, 4096] {
        assert_eq!(noticed(&whole, lost), 1.0, "{lost} bytes lost");
        let at = whole.len() / 2;
        let bytes = [&whole[..at], &whole[at + lost..]].concat();
        assert!(warnings(&bytes)[0].contains("missing or changed"), "{lost} bytes lost");
    }
}

#[test]
fn some_losses_of_a_few_bytes_are_noticed() {
    // Huffman codes synchronise again, so that most of these change a few blocks and leave no trace.
    let share = noticed(&plain(), 3);
    assert!(share > 0.2, "{share}");
}

#[test]
fn what_cameras_append_or_repeat_is_ignored() {
    let whole = plain();
    let complete = decode(&whole, LIMITS, Needed::All).unwrap().pixels;
    let (data, end) = whole.split_at(whole.len() - 2);
    for (name, bytes) in [
        ("zeros after the end", [&whole[..], &[0; 3000]].concat()),
        ("noise after the end", [&whole[..], b"\xFF\xD8\xFF\xE0 and so on"].concat()),
        ("a second picture", [&whole[..], SCENES[1]].concat()),
        ("zeros before the end", [data, &[0; 64], end].concat()),
        ("fill bytes before the end", [data, &[0xFF; 64], end].concat()),
    ] {
        let picture = decode(&bytes, LIMITS, Needed::All).unwrap();
        assert!(picture.pixels == complete, "{name}");
        assert_eq!(picture.warnings, Vec::<String>::new(), "{name}");
    }
}

/// A JPEG with a restart marker after each row of units, as many webcams write them. Pillow made it from the street by
/// day: `save(…, quality=70, restart_marker_rows=1)` at 320×240.
const WITH_RESTARTS: &[u8] = include_bytes!("../../samples/restarts.jpg");

/// The positions of the restart markers.
fn restarts(bytes: &[u8]) -> Vec<usize> {
    let start = data_start(bytes);
    let is_restart = |at: &usize| bytes[*at] == 0xFF && (0xD0..=0xD7).contains(&bytes[at + 1]);
    (start..bytes.len() - 1).filter(is_restart).collect()
}

#[test]
fn bytes_too_many_before_restart_markers_are_no_damage() {
    let whole = WITH_RESTARTS.to_vec();
    let complete = decode(&whole, LIMITS, Needed::All).unwrap();
    assert!(restarts(&whole).len() > 10 && complete.warnings.is_empty());
    let mut padded = whole.clone();
    for (count, at) in restarts(&whole).into_iter().enumerate().rev() {
        padded.splice(at..at, (0..count as u8 % 4).map(|byte| byte * 37));
    }
    let picture = decode(&padded, LIMITS, Needed::All).unwrap();
    assert!(picture.pixels == complete.pixels && picture.warnings.is_empty());
}

#[test]
fn lost_intervals_are_noticed() {
    let whole = WITH_RESTARTS.to_vec();
    let markers = restarts(&whole);
    for lost in [1, 3, 8] {
        let bytes = [&whole[..markers[4]], &whole[markers[4 + lost]..]].concat();
        assert_eq!(warnings(&bytes).len(), 1, "{lost} intervals lost");
    }
    let bytes = [&whole[..markers[2] + 200], &whole[markers[6] + 200..]].concat();
    assert_eq!(warnings(&bytes).len(), 1);
}

#[test]
fn webcam_frames_without_huffman_tables_use_the_standard_ones() {
    // MJPEG frames leave out the tables (USB Video Class, MJPEG payload), which this encoder does not change.
    let whole = plain();
    let mut bare = whole.clone();
    while let Some(at) = bare.windows(2).position(|pair| pair == [0xFF, 0xC4]) {
        let length = usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]]));
        bare.drain(at..at + 2 + length);
    }
    assert!(bare.len() + 400 < whole.len());
    let picture = decode(&bare, LIMITS, Needed::All).unwrap();
    assert!(picture.pixels == scene_of(&whole) && picture.warnings.is_empty());
}

fn scene_of(bytes: &[u8]) -> RgbImage {
    decode(bytes, LIMITS, Needed::All).unwrap().pixels
}

#[test]
fn a_cmyk_jpeg_is_decoded() {
    let scene = scene();
    let cmyk: Vec<u8> = scene
        .pixels()
        .flat_map(|p| [255 - p[0], 255 - p[1], 255 - p[2], 0].map(|ink| 255 - ink))
        .collect();
    let mut encoder = mozjpeg::Compress::new(mozjpeg::ColorSpace::JCS_CMYK);
    encoder.set_fastest_defaults();
    encoder.set_size(scene.width() as usize, scene.height() as usize);
    encoder.set_quality(95.0);
    let mut started = encoder.start_compress(Vec::new()).unwrap();
    started.write_scanlines(&cmyk).unwrap();
    let picture = decode(&started.finish().unwrap(), LIMITS, Needed::All).unwrap();
    assert_eq!(picture.pixels.dimensions(), scene.dimensions());
}
