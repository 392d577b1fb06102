//! Positions in XMP packets, and metadata that PNG pictures have as text.

use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;

use super::writer::{Writer, app1, chunk, jpeg, png, segment, webp};
use super::*;

const EXIF_NS: &str = "xmlns:exif='http://ns.adobe.com/exif/1.0/'";
const DJI_NS: &str = "xmlns:drone-dji=\"http://www.dji.com/drone-dji/1.0/\"";

/// A packet with these attributes and elements.
fn packet(attributes: &str, elements: &str) -> String {
    format!(
        "<?xpacket begin='\u{feff}' id='W5M0MpCehiHzreSzNTczkc9d'?><x:xmpmeta xmlns:x='adobe:ns:meta/'>\
         <rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><rdf:Description rdf:about=''\n \
         {attributes}>{elements}</rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end='w'?>"
    )
}

fn exif_packet(attributes: &str) -> String {
    packet(&format!("{EXIF_NS} {attributes}"), "")
}

fn dji(attributes: &str) -> String {
    packet(&format!("{DJI_NS} {attributes}"), "")
}

fn in_jpeg(packet: &str) -> Vec<u8> {
    segment(0xE1, &[b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes()].concat())
}

fn usual_packet() -> String {
    exif_packet("exif:GPSLatitude='45,12,30N' exif:GPSLongitude='30,0,1W'")
}

fn deflated(data: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(data).unwrap();
    encoder.finish().unwrap()
}

/// A raw profile as ImageMagick writes it.
fn raw_profile(kind: &str, data: &[u8]) -> Vec<u8> {
    let digits: Vec<String> = data.iter().map(|byte| format!("{byte:02x}")).collect();
    let lines: Vec<String> = digits.chunks(36).map(|line| line.concat()).collect();
    format!("\n{kind}\n{:8}\n{}\n", data.len(), lines.join("\n")).into_bytes()
}

fn text(keyword: &str, behind: &[u8], text: &[u8]) -> Vec<u8> {
    [keyword.as_bytes(), b"\0", behind, text].concat()
}

#[test]
fn every_form_of_an_xmp_position_is_read_or_warned_about() {
    let with = |lat: &str, more: &str| {
        exif_packet(&format!("exif:GPSLatitude=\"{lat}\" exif:GPSLongitude=\"30,0,1W\" {more}"))
    };
    let near = |lat: f64| Some((lat, LON, None, None));
    let elements = "<exif:GPSLatitude>45,12,30N</exif:GPSLatitude>\n<!-- <exif:GPSLatitude>1,2,3N -->\
                    <exif:GPSLongitude> 30,0,1W </exif:GPSLongitude>";
    let (gps, absolute) = (
        "drone-dji:GpsLatitude=\"+45.20833333\" drone-dji:GpsLongitude=\"-30.00027778\"",
        "drone-dji:AbsoluteAltitude=\"+240.50\"",
    );
    let panorama =
        "xmlns:GPano=\"http://ns.google.com/photos/1.0/panorama/\" GPano:PoseHeadingDegrees=\"90\"";
    let rows: Vec<(&str, String, Expected, &str)> = vec![
        ("degrees, minutes, seconds", usual_packet(), PLACE, ""),
        ("minutes with decimals", with("45,12.5N", ""), PLACE, ""),
        ("six decimals", with("45,12.500000N", ""), PLACE, ""),
        ("a space before the letter", with("45, 12.5 n", ""), PLACE, ""),
        ("south", with("45,12.5S", ""), near(-LAT), ""),
        ("as elements", packet(EXIF_NS, elements), PLACE, ""),
        (
            "an unusual prefix",
            usual_packet().replace("exif:GPS", "e:GPS").replace("xmlns:exif", "xmlns:e"),
            PLACE,
            "",
        ),
        ("an undeclared prefix", usual_packet().replace(EXIF_NS, ""), PLACE, ""),
        (
            "another namespace",
            usual_packet().replace("adobe.com/exif", "adobe.com/other"),
            None,
            "",
        ),
        (
            "a letter in a property of its own",
            with("45.2083333333", "exif:GPSLatitudeRef='North'"),
            PLACE,
            "",
        ),
        ("no letter", with("45,12.5", ""), None, "no hemisphere letter"),
        ("no longitude", exif_packet("exif:GPSLatitude='45,12.5N'"), None, "no longitude"),
        (
            "zeros",
            exif_packet("exif:GPSLatitude='0,0N' exif:GPSLongitude='0,0E'"),
            None,
            "without a fix",
        ),
        ("no numbers", with("N", ""), None, "not a number of degrees"),
        ("off the globe", with("95,0N", ""), None, "not on the globe"),
        ("an altitude", with("45,12.5N", "exif:GPSAltitude='2405/10'"), raised(240.5), ""),
        (
            "an altitude below the sea",
            with("45,12.5N", "exif:GPSAltitude='2405/10' exif:GPSAltitudeRef='1'"),
            raised(-240.5),
            "",
        ),
        ("a heading", with("45,12.5N", "exif:GPSImgDirection='9050/100'"), turned(90.5), ""),
        ("a heading of 720", with("45,12.5N", "exif:GPSImgDirection='720/1'"), PLACE, "heading"),
        ("a panorama", with("45,12.5N", panorama), turned(90.0), ""),
        ("a drone", dji(&format!("{gps} {absolute}")), raised(240.5), ""),
        (
            "a drone with the angle of its camera",
            dji(&format!(
                "{gps} drone-dji:GimbalYawDegree=\"-90.00\" drone-dji:FlightYawDegree='10'"
            )),
            turned(270.0),
            "",
        ),
        (
            "a drone whose altitude is above the take-off point",
            dji(&format!("{gps} drone-dji:RelativeAltitude=\"+30.20\"")),
            PLACE,
            "take-off",
        ),
        (
            "a drone with the slip of the pen",
            dji(&gps.replace("GpsLongitude", "GpsLongtitude")),
            PLACE,
            "",
        ),
        (
            "a drone without a fix",
            dji("drone-dji:GpsLatitude='0.0' drone-dji:GpsLongitude='0.0'"),
            None,
            "",
        ),
        (
            "a drone off the globe",
            dji("drone-dji:GpsLatitude='95' drone-dji:GpsLongitude='0.0'"),
            None,
            "",
        ),
        (
            "a drone that says nan",
            dji("drone-dji:GpsLatitude='nan' drone-dji:GpsLongitude='inf'"),
            None,
            "",
        ),
        ("no packet", String::new(), None, ""),
    ];
    for (habit, packet, expected, warning) in rows {
        assert_reads(habit, &jpeg(&[in_jpeg(&packet)]), expected, warning);
    }
}

#[test]
fn metadata_are_found_in_every_container() {
    let (packet, tiff) = (usual_packet(), Writer::new(usual()).tiff());
    let of_png = |kind: &[u8; 4], data: Vec<u8>| png(&[chunk(kind, &data), chunk(b"IEND", b"")]);
    let xmp_key = "XML:com.adobe.xmp";
    let split = packet.len() / 2;
    let part = |offset: usize, text: &str| {
        let head =
            [&[b'A'; 32][..], &(packet.len() as u32).to_be_bytes(), &(offset as u32).to_be_bytes()];
        let data = [b"http://ns.adobe.com/xmp/extension/\0", &head.concat()[..], text.as_bytes()];
        segment(0xE1, &data.concat())
    };
    let app1 = [b"Exif\0\0", &tiff[..]].concat();
    let app1_xmp = [b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes()].concat();
    let writer = Writer::new(Vec::new());
    let tag_700 = writer.directory(8, &[(700, Raw::Bytes(BYTE, packet.clone().into_bytes()))]);
    let rows: Vec<(&str, Vec<u8>)> = vec![
        (
            "JPEG, XMP that continues",
            jpeg(&[part(0, &packet[..split]), part(split, &packet[split..])]),
        ),
        ("PNG, iTXt", of_png(b"iTXt", text(xmp_key, b"\0\0\0\0", packet.as_bytes()))),
        (
            "PNG, compressed iTXt",
            of_png(b"iTXt", text(xmp_key, b"\x01\0en\0x\0", &deflated(packet.as_bytes()))),
        ),
        ("PNG, tEXt", of_png(b"tEXt", text(xmp_key, b"", packet.as_bytes()))),
        ("PNG, zTXt", of_png(b"zTXt", text(xmp_key, b"\0", &deflated(packet.as_bytes())))),
        (
            "PNG, raw profile exif",
            of_png(b"tEXt", text("Raw profile type exif", b"", &raw_profile("exif", &app1))),
        ),
        (
            "PNG, compressed raw profile exif without a header",
            of_png(
                b"zTXt",
                text("Raw profile type exif", b"\0", &deflated(&raw_profile("exif", &tiff))),
            ),
        ),
        (
            "PNG, raw profile APP1",
            of_png(
                b"tEXt",
                text("Raw profile type APP1", b"", &raw_profile("generic profile", &app1)),
            ),
        ),
        (
            "PNG, raw profile APP1 with XMP",
            of_png(b"tEXt", text("Raw profile type APP1", b"", &raw_profile("APP1", &app1_xmp))),
        ),
        (
            "PNG, raw profile xmp",
            of_png(
                b"zTXt",
                text(
                    "Raw profile type xmp",
                    b"\0",
                    &deflated(&raw_profile("xmp", packet.as_bytes())),
                ),
            ),
        ),
        ("WebP", webp(&[(b"VP8 ", vec![1; 5]), (b"XMP ", packet.clone().into_bytes())])),
        ("WebP, NUL in the name", webp(&[(b"XMP\0", packet.clone().into_bytes())])),
        ("TIFF", [&b"II*\0\x08\0\0\0"[..], &tag_700].concat()),
        (
            "GIF",
            [b"GIF89a pixels!\xFF\x0BXMP DataXMP", packet.as_bytes(), b"\x01\xFF\xFE\0;"].concat(),
        ),
    ];
    for (container, bytes) in &rows {
        assert_reads(container, bytes, PLACE, "");
        for length in 0..bytes.len() {
            gps(&bytes[..length]);
        }
    }
}

#[test]
fn exif_comes_before_xmp_which_adds_the_heading_of_a_drone() {
    let exif = app1(&Writer::new(usual()).tiff());
    let other = exif_packet("exif:GPSLatitude='1,0N' exif:GPSLongitude='2,0E'");
    assert_reads("both", &jpeg(&[in_jpeg(&other), exif.clone()]), PLACE, "");
    let turned_90 = dji(
        "drone-dji:GimbalYawDegree='+90.0' drone-dji:GpsLatitude='1' drone-dji:GpsLongitude='2'",
    );
    assert_reads("a drone", &jpeg(&[exif.clone(), in_jpeg(&turned_90)]), turned(90.0), "");
    let no_fix = app1(&Writer::new(with(&[set(2, dms(&[(0, 0)]))])).tiff());
    assert_reads("no EXIF fix", &jpeg(&[no_fix, in_jpeg(&usual_packet())]), PLACE, "");
    let no_letter = app1(&Writer::new(with(&[(1, None)])).tiff());
    assert_reads("no letter in EXIF", &jpeg(&[no_letter, in_jpeg(&usual_packet())]), PLACE, "");
}

#[test]
fn a_text_that_decompresses_without_end_is_bounded() {
    let zeros = deflated(&vec![b'<'; 64 << 20]);
    let bomb = chunk(b"zTXt", &text("XML:com.adobe.xmp", b"\0", &zeros));
    let start = std::time::Instant::now();
    assert_reads("a bomb", &png(&vec![bomb; 30]), None, "");
    assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
}
