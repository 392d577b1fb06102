//! The habits of cameras and taggers, one row each: what they write, and the pose that follows from it.

mod writer;
mod xmp;

use self::writer::*;
use super::*;

fn letter(text: &'static [u8]) -> Raw {
    Raw::Text(ASCII, text)
}

fn dms(parts: &[(u32, u32)]) -> Raw {
    Raw::Fractions(parts.to_vec())
}

/// 45° 12′ 30″ north, 30° 0′ 1″ west.
fn usual() -> Vec<(u16, Raw)> {
    vec![
        (1, letter(b"N\0")),
        (2, dms(&[(45, 1), (12, 1), (30, 1)])),
        (3, letter(b"W\0")),
        (4, dms(&[(30, 1), (0, 1), (1, 1)])),
    ]
}

const LAT: f64 = 45.0 + 12.0 / 60.0 + 30.0 / 3600.0;
const LON: f64 = -30.0 - 1.0 / 3600.0;

/// The usual fields, some of them replaced, added, or (with no value) removed.
fn with(changes: &[(u16, Option<Raw>)]) -> Vec<(u16, Raw)> {
    let mut fields = usual();
    for (tag, raw) in changes {
        fields.retain(|(other, _)| other != tag);
        fields.extend(raw.clone().map(|raw| (*tag, raw)));
    }
    fields.sort_by_key(|(tag, _)| *tag);
    fields
}

fn set(tag: u16, raw: Raw) -> (u16, Option<Raw>) {
    (tag, Some(raw))
}

/// What a habit is called, the fields that are written, the expected pose, and a part of the warning.
type Habit = (&'static str, Vec<(u16, Raw)>, Expected, &'static str);

/// The expected latitude, longitude, altitude and heading.
type Expected = Option<(f64, f64, Option<f64>, Option<f64>)>;

const PLACE: Expected = Some((LAT, LON, None, None));

fn raised(alt: f64) -> Expected {
    Some((LAT, LON, Some(alt), None))
}

fn turned(heading: f64) -> Expected {
    Some((LAT, LON, None, Some(heading)))
}

/// Asserts the pose, and that the only warning contains `warning`, or that there is none if it is empty.
fn assert_reads(habit: &str, bytes: &[u8], expected: Expected, warning: &str) {
    let GpsReading { pose, warnings } = gps(bytes);
    match (pose, expected) {
        (None, None) => {}
        (Some(pose), Some((lat, lon, alt, heading))) => {
            let near = |a: f64, b: f64| (a - b).abs() < 1e-6;
            let same = |a: Option<f64>, b: Option<f64>| match (a, b) {
                (None, None) => true,
                (Some(a), Some(b)) => near(a, b),
                _ => false,
            };
            assert!(near(pose.lat, lat) && near(pose.lon, lon), "{habit}: {pose:?}");
            assert!(same(pose.alt, alt) && same(pose.heading, heading), "{habit}: {pose:?}");
        }
        (pose, _) => panic!("{habit}: {pose:?}, {warnings:?}"),
    }
    match warning {
        "" => assert!(warnings.is_empty(), "{habit}: {warnings:?}"),
        text => assert!(warnings.len() == 1 && warnings[0].contains(text), "{habit}: {warnings:?}"),
    }
}

#[test]
fn every_habit_of_coordinates_is_read_or_warned_about() {
    let lat = |raw: Raw| with(&[set(2, raw)]);
    let (no_fix, zero) = ([(0, 0), (0, 0), (0, 0)], [(0, 1), (0, 1), (0, 1)]);
    let at = |lat: f64| Some((lat, LON, None, None));
    let rows: Vec<Habit> = vec![
        ("degrees, minutes, seconds", usual(), PLACE, ""),
        ("no GPS at all", vec![], None, ""),
        ("only a GPS version", vec![(0, Raw::Bytes(BYTE, vec![2, 3, 0, 0]))], None, ""),
        (
            "southern and eastern",
            with(&[set(1, letter(b"S\0")), set(3, letter(b"E\0"))]),
            Some((-LAT, -LON, None, None)),
            "",
        ),
        (
            "minutes with decimals, seconds 0/1",
            lat(dms(&[(45, 1), (1250, 100), (0, 1)])),
            at(45.0 + 12.5 / 60.0),
            "",
        ),
        ("unused seconds 0/0", lat(dms(&[(45, 1), (12, 1), (0, 0)])), at(45.2), ""),
        ("unused minutes and seconds 0/0", lat(dms(&[(452, 10), (0, 0), (0, 0)])), at(45.2), ""),
        ("two components", lat(dms(&[(45, 1), (1250, 100)])), at(45.0 + 12.5 / 60.0), ""),
        ("one component, decimal degrees", lat(dms(&[(45_208_333, 1_000_000)])), at(45.208333), ""),
        (
            "seconds with a huge denominator",
            lat(dms(&[(45, 1), (12, 1), (4_294_967_280, 143_165_576)])),
            PLACE,
            "",
        ),
        ("seconds rounded up to 60", lat(dms(&[(45, 1), (11, 1), (60, 1)])), at(45.2), ""),
        ("no fix: 0/0 everywhere", with(&[set(2, dms(&no_fix)), set(4, dms(&no_fix))]), None, ""),
        ("no fix: 0/0 in one coordinate", lat(dms(&no_fix)), None, ""),
        ("no fix: zeros", with(&[set(2, dms(&zero)), set(4, dms(&zero))]), None, "without a fix"),
        ("on the equator", lat(dms(&zero)), at(0.0), ""),
        ("on the zero meridian", with(&[set(4, dms(&zero))]), Some((LAT, 0.0, None, None)), ""),
        (
            "a fraction 12/0",
            lat(dms(&[(45, 1), (12, 0), (30, 1)])),
            None,
            "not a number of degrees",
        ),
        ("degrees 45/0", lat(dms(&[(45, 0), (12, 1), (30, 1)])), None, "not a number of degrees"),
        (
            "four components",
            lat(dms(&[(45, 1), (12, 1), (30, 1), (5, 1)])),
            None,
            "not a number of degrees",
        ),
        (
            "no letter of the latitude",
            with(&[(1, None)]),
            None,
            "latitude has no hemisphere letter (N or S)",
        ),
        (
            "no letter of the longitude",
            with(&[(3, None)]),
            None,
            "longitude has no hemisphere letter (E or W)",
        ),
        ("an empty letter", with(&[set(1, letter(b"\0\0"))]), None, "no hemisphere letter"),
        (
            "numbers 0 and 1 as letters",
            with(&[set(1, Raw::Bytes(BYTE, vec![1]))]),
            None,
            "no hemisphere letter",
        ),
        (
            "the letter of the other axis",
            with(&[set(1, letter(b"E\0"))]),
            None,
            "no hemisphere letter",
        ),
        (
            "a lower-case letter",
            with(&[set(1, letter(b"s\0")), set(3, letter(b"w\0"))]),
            Some((-LAT, LON, None, None)),
            "",
        ),
        ("a letter without NUL", with(&[set(1, letter(b"S"))]), at(-LAT), ""),
        ("a whole word", with(&[set(1, letter(b"South\0"))]), at(-LAT), ""),
        ("spaces around a letter", with(&[set(1, letter(b" S \0"))]), at(-LAT), ""),
        ("a letter as UNDEFINED", with(&[set(1, Raw::Text(UNDEFINED, b"S\0"))]), at(-LAT), ""),
        ("a letter as BYTE", with(&[set(1, Raw::Text(BYTE, b"S\0"))]), at(-LAT), ""),
        ("signed fractions", lat(Raw::Signed(vec![(45, 1), (12, 1), (30, 1)])), PLACE, ""),
        (
            "signed and S",
            with(&[set(1, letter(b"S\0")), set(2, Raw::Signed(vec![(-45, 1), (12, 1), (30, 1)]))]),
            at(-LAT),
            "",
        ),
        (
            "signed and S, negative denominator",
            with(&[set(1, letter(b"S\0")), set(2, Raw::Signed(vec![(45, -1), (12, 1), (30, 1)]))]),
            at(-LAT),
            "",
        ),
        (
            "signed, but N",
            lat(Raw::Signed(vec![(-45, 1), (12, 1), (30, 1)])),
            None,
            "negative, but its letter is N",
        ),
        (
            "a negative number in an unsigned fraction",
            lat(dms(&[(u32::MAX - 44, 1), (12, 1), (30, 1)])),
            None,
            "not on the globe",
        ),
        ("91 degrees north", lat(dms(&[(91, 1), (0, 1), (0, 1)])), None, "not on the globe"),
        ("text with commas", lat(letter(b"45,12,30\0")), PLACE, ""),
        ("text in decimals", lat(letter(b"45.2\0")), at(45.2), ""),
        ("text with fractions", lat(letter(b"45/1 12/1 30/1\0")), PLACE, ""),
        ("text with units", lat(letter(b"45 deg 12' 30.00\" N\0")), PLACE, ""),
        (
            "text with its own letter",
            with(&[(1, None), set(2, letter(b"45,12.5S\0"))]),
            at(-45.0 - 12.5 / 60.0),
            "",
        ),
        (
            "text with units, without any letter",
            with(&[(3, None), set(4, letter(b"30 deg 0' 1\"\0"))]),
            None,
            "no hemisphere letter",
        ),
        ("text without numbers", lat(letter(b"unknown\0")), None, "not a number of degrees"),
        ("floats", lat(Raw::Floats(vec![45.0, 12.0, 30.0])), PLACE, ""),
        ("doubles", lat(Raw::Doubles(vec![45.0, 12.0, 30.0])), PLACE, ""),
        ("NaN", lat(Raw::Doubles(vec![f64::NAN])), None, "not a number of degrees"),
        ("whole numbers", lat(Raw::Shorts(vec![45, 12, 30])), PLACE, ""),
        ("long numbers", lat(Raw::Longs(vec![45, 12, 30])), PLACE, ""),
        ("an empty coordinate", lat(dms(&[])), None, "not a number of degrees"),
        ("a latitude alone", with(&[(3, None), (4, None)]), None, "no longitude"),
        ("a longitude alone", with(&[(1, None), (2, None)]), None, "no latitude"),
        ("a void position", with(&[set(9, letter(b"V\0"))]), PLACE, "void"),
        ("an active position", with(&[set(9, letter(b"A\0"))]), PLACE, ""),
    ];
    for (habit, fields, expected, warning) in rows {
        for is_big_endian in [false, true] {
            for next in [Next::Zero, Next::Absent, Next::MinusOne] {
                let writer = Writer { is_big_endian, next, ..Writer::new(fields.clone()) };
                assert_reads(habit, &jpeg(&[app1(&writer.tiff())]), expected, warning);
            }
        }
    }
}

#[test]
fn every_habit_of_altitudes_and_headings_keeps_the_position() {
    let alt = |raw: Raw| with(&[set(6, raw)]);
    let below = |reference: Raw| with(&[set(5, reference), set(6, dms(&[(2405, 10)]))]);
    let heading = |raw: Raw| with(&[set(17, raw)]);
    let rows: Vec<Habit> = vec![
        ("an altitude", alt(dms(&[(2405, 10)])), raised(240.5), ""),
        ("above the sea", below(Raw::Bytes(BYTE, vec![0])), raised(240.5), ""),
        ("below the sea", below(Raw::Bytes(BYTE, vec![1])), raised(-240.5), ""),
        ("above the ellipsoid", below(Raw::Bytes(BYTE, vec![2])), raised(240.5), ""),
        ("below the ellipsoid", below(Raw::Bytes(BYTE, vec![3])), raised(-240.5), ""),
        ("the reference as a digit", below(letter(b"1\0")), raised(-240.5), ""),
        ("the reference as a short", below(Raw::Shorts(vec![1])), raised(-240.5), ""),
        ("an empty reference", below(Raw::Bytes(BYTE, vec![])), raised(240.5), ""),
        ("a signed altitude", alt(Raw::Signed(vec![(-2405, 10)])), raised(-240.5), ""),
        (
            "a signed altitude, below",
            with(&[set(5, Raw::Bytes(BYTE, vec![1])), set(6, Raw::Signed(vec![(-2405, 10)]))]),
            raised(-240.5),
            "",
        ),
        ("an altitude as text", alt(letter(b"240.5 m\0")), raised(240.5), ""),
        ("an unknown altitude", alt(dms(&[(0, 0)])), PLACE, ""),
        ("an altitude 5/0", alt(dms(&[(5, 0)])), PLACE, "altitude is out of range"),
        ("an altitude of all ones", alt(dms(&[(u32::MAX, 1)])), PLACE, "altitude is out of range"),
        ("an empty altitude", alt(dms(&[])), PLACE, ""),
        ("a heading", heading(dms(&[(9050, 100)])), turned(90.5), ""),
        ("a heading of 360", heading(dms(&[(360, 1)])), turned(360.0), ""),
        (
            "a true heading",
            with(&[set(16, letter(b"T\0")), set(17, dms(&[(90, 1)]))]),
            turned(90.0),
            "",
        ),
        (
            "a magnetic heading",
            with(&[set(16, letter(b"M\0")), set(17, dms(&[(90, 1)]))]),
            turned(90.0),
            "magnetic",
        ),
        ("a heading of 720", heading(dms(&[(72000, 100)])), PLACE, "heading is not between"),
        ("a heading of 65535", heading(dms(&[(65535, 1)])), PLACE, "heading is not between"),
        ("a heading of 655.35", heading(dms(&[(65535, 100)])), PLACE, "heading is not between"),
        ("a heading from −180 to 180", heading(Raw::Signed(vec![(-90, 1)])), turned(270.0), ""),
        ("an unknown heading", heading(dms(&[(0, 0)])), PLACE, ""),
        ("a heading 1/0", heading(dms(&[(1, 0)])), PLACE, "heading is not between"),
        ("a heading as text", heading(letter(b"90.5\0")), turned(90.5), ""),
        (
            "a dropped magnetic heading warns once",
            with(&[set(16, letter(b"M\0")), set(17, dms(&[(720, 1)]))]),
            PLACE,
            "not between",
        ),
    ];
    for (habit, fields, expected, warning) in rows {
        assert_reads(habit, &jpeg(&[app1(&Writer::new(fields).tiff())]), expected, warning);
    }
}

#[test]
fn exif_is_found_in_every_container() {
    let tiff = Writer::new(usual()).tiff();
    let exif = app1(&tiff);
    let with_header = [b"Exif\0\0", &tiff[..]].concat();
    let jfif = segment(0xE0, b"JFIF\0\x01\x01\0\0\x01\0\x01\0\0");
    let xmp = segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta/>");
    let flir = segment(0xE1, b"FLIR\0\x01\0\0 binary");
    let empty = app1(&Writer::new(vec![]).tiff());
    let (ihdr, idat, iend) =
        (chunk(b"IHDR", &[0; 13]), chunk(b"IDAT", b"pixels"), chunk(b"IEND", b""));
    let odd = [&tiff[..], &[0]].concat();
    let raw = [b"IIRO", &tiff[4..]].concat();
    let rows: Vec<(&str, Vec<u8>)> = vec![
        ("JPEG, EXIF first", jpeg(std::slice::from_ref(&exif))),
        (
            "JPEG, EXIF after JFIF, XMP and FLIR segments",
            jpeg(&[jfif.clone(), xmp.clone(), flir, exif.clone()]),
        ),
        ("JPEG, XMP after EXIF", jpeg(&[exif.clone(), xmp])),
        ("JPEG, a first EXIF segment without a position", jpeg(&[empty, exif.clone()])),
        ("JPEG, an empty first EXIF segment", jpeg(&[segment(0xE1, b"Exif\0\0"), exif.clone()])),
        ("JPEG, EXIF split over two segments", jpeg(&[app1(&tiff[..60]), app1(&tiff[60..])])),
        (
            "JPEG, fill bytes before a marker",
            jpeg(&[jfif.clone(), vec![0xFF, 0xFF, 0xFF], exif.clone()]),
        ),
        ("JPEG, padding between segments", jpeg(&[jfif, vec![0; 7], exif.clone()])),
        (
            "JPEG, EXIF with 0xFF in its header",
            jpeg(&[segment(0xE1, &[b"Exif\0\xFF", &tiff[..]].concat())]),
        ),
        ("JPEG, cut behind its EXIF", jpeg(std::slice::from_ref(&exif))[..2 + exif.len()].to_vec()),
        (
            "PNG, eXIf before the pixels",
            png(&[ihdr.clone(), chunk(b"eXIf", &tiff), idat.clone(), iend.clone()]),
        ),
        (
            "PNG, eXIf after the pixels",
            png(&[ihdr.clone(), idat.clone(), chunk(b"eXIf", &tiff), iend.clone()]),
        ),
        ("PNG, eXIf with a header", png(&[ihdr, chunk(b"eXIf", &with_header), idat, iend])),
        ("WebP", webp(&[(b"VP8X", vec![0; 10]), (b"VP8 ", vec![1; 5]), (b"EXIF", tiff.clone())])),
        ("WebP with a header", webp(&[(b"EXIF", with_header.clone())])),
        ("WebP, a chunk of odd length", webp(&[(b"VP8 ", vec![1; 5]), (b"EXIF", odd)])),
        ("TIFF", tiff.clone()),
        ("a camera's raw format", raw),
        ("HEIF", [b"\0\0\0\x18ftypheic\0\0\0\0mif1heic\0\0\0\x06", &with_header[..]].concat()),
    ];
    for (container, bytes) in rows {
        assert_reads(container, &bytes, PLACE, "");
    }
    for bytes in
        [b"".as_slice(), b"\xFF\xD8", b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\0WEBP", b"II*\0", b"text"]
    {
        assert_reads("no EXIF data", bytes, None, "");
    }
}

#[test]
fn a_position_is_found_in_a_later_directory() {
    // The first directory has only a pointer to the second, in which the GPS directory is.
    let later = Writer::new(usual());
    let mut bytes = b"II*\0\x08\0\0\0\0\0".to_vec();
    let second = bytes.len() + 4;
    bytes.extend((second as u32).to_le_bytes());
    bytes.extend(later.directory(second, &[(0x8825, Raw::Longs(vec![(second + 18) as u32]))]));
    bytes.extend(later.directory(second + 18, &usual()));
    assert_reads("the second directory", &bytes, PLACE, "");
    // A pointer of two bytes.
    let mut short = b"II*\0\x08\0\0\0".to_vec();
    short.extend(later.directory(8, &[(0x8825, Raw::Shorts(vec![26]))]));
    short.extend(later.directory(26, &usual()));
    assert_reads("a short pointer", &short, PLACE, "");
}

#[test]
fn a_field_outside_the_structure_costs_only_itself() {
    let mut fields = usual();
    fields.push((17, dms(&[(90, 1)])));
    let tiff = Writer::new(fields).tiff();
    // The heading is the last value; without it, the position is still there.
    assert_reads("a cut heading", &jpeg(&[app1(&tiff[..tiff.len() - 4])]), PLACE, "");
    for length in 0..tiff.len() {
        gps(&jpeg(&[app1(&tiff[..length])]));
    }
}

#[test]
fn directories_that_point_at_each_other_end() {
    let mut bytes = b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x08".to_vec();
    bytes.extend(8_u32.to_be_bytes());
    assert_eq!(gps(&bytes), GpsReading::default());
}
