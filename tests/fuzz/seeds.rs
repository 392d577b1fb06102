//! Valid inputs to start from.

use std::io::{Cursor, Write};
use std::ops::Range;

use bytes::Bytes;
use exif::experimental::Writer as ExifWriter;
use exif::{Field, In, Rational, Tag, Value};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use image::codecs::jpeg::JpegEncoder;
use image::{ImageFormat, RgbImage};
use jiff::Timestamp;
use rayon::ThreadPoolBuilder;
use uuid::Uuid;
use whereabouts_archive::{ArchivedMap, LeftOut, Manifest, Writer};
use whereabouts_core::{
    CoordinateFrame, Descriptor, DescriptorKind, Digest, Image, Map, MediaType, Precision, Scene,
};
use whereabouts_core::{ExportedImage, ImageTexts, TextLine};
use whereabouts_index::{IndexSettings, MapIndex, Vectors};
use whereabouts_town::{Town, TownSpec};

pub fn pictures() -> Vec<Vec<u8>> {
    let town =
        Town::new(TownSpec { seed: 3, places: 2, width: 96, height: 64, ..TownSpec::default() });
    let pixels: RgbImage = town.reference(0).image;
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, 80).encode_image(&pixels).unwrap();
    let encoded = |format: ImageFormat| {
        let mut bytes = Cursor::new(Vec::new());
        pixels.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    };
    let turned = with_exif(&jpeg, &exif_of([oriented(6)].as_slice()));
    let others = [
        ImageFormat::Png,
        ImageFormat::WebP,
        ImageFormat::Tiff,
        ImageFormat::Bmp,
        ImageFormat::Gif,
        ImageFormat::Pnm,
    ];
    [jpeg, turned].into_iter().chain(others.map(encoded)).collect()
}

pub fn manifests() -> Vec<Vec<u8>> {
    let tokens = r#"
        name = "tokens"
        description = "A transformer."
        file = "model.onnx"
        sha256 = "a67c47cd670a0656d665192ad1b42d0ff479f7a2d50ea9d9aa9ce72b99672808"
        licence = "Apache-2.0"
        source = "nowhere"
        [input]
        name = "pixel_values"
        width = 224
        height = 224
        resize = "centre_crop"
        interpolation = "bicubic"
        multiple = 14
        mean = [0.485, 0.456, 0.406]
        std = [0.229, 0.224, 0.225]
        [output]
        features = "last_hidden_state"
        layout = "tokens"
        channels = 384
        stride = 14
        registers = 0
        cls = true
        [pooling]
        gem_p = 3.0
        grid = [1, 1]
        dimension = 384
    "#;
    let xfeat = include_str!("../../deploy/models/xfeat.toml");
    texts(&[xfeat, tokens])
}

struct Rows(Vec<Vec<f32>>);

impl Vectors for Rows {
    fn dim(&self) -> usize {
        8
    }

    fn scan(&self, slots: Range<usize>, visit: &mut dyn FnMut(usize, &[f32])) {
        slots.for_each(|slot| visit(slot, &self.0[slot]));
    }
}

pub fn graphs() -> Vec<Vec<u8>> {
    let settings = IndexSettings {
        exact_up_to: 0,
        m: 4,
        ef_construction: 20,
        ef_search: 20,
        threads: 0,
        max_dead_share: 1.0,
        check_s: 0,
    };
    let row = |slot: usize| {
        let numbers =
            (0..8).map(|axis| ((slot * 7 + axis * 3) % 11) as f32 - 5.0 + slot as f32 * 0.01);
        Descriptor::normalised(numbers.collect()).unwrap().as_slice().to_vec()
    };
    let rows = Rows((0..60).map(row).collect());
    let index = MapIndex::new(settings);
    (0..60).for_each(|slot| index.add(slot));
    let threads = ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 64, &threads).or(sealed);
    }
    vec![sealed.unwrap().to_bytes()]
}

pub fn archives() -> Vec<Vec<u8>> {
    let dir = tempfile::TempDir::new().unwrap();
    let path = dir.path().join("backup.tar");
    let map = Map {
        uid: Uuid::nil(),
        name: "a".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "m".into(),
        model_digest: Digest::of(b"m"),
        precision: Precision::Full,
        dim: 2,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::UNIX_EPOCH,
    };
    let bytes = Bytes::from_static(b"picture");
    let image = Image {
        id: "1".parse().unwrap(),
        digest: Digest::of(&bytes),
        pose: None,
        captured_at: None,
        tags: vec![],
        media_type: MediaType::Jpeg,
        width: 1,
        height: 1,
        created_at: Timestamp::UNIX_EPOCH,
    };
    let descriptor = Some(Descriptor::normalised(vec![1.0, 2.0]).unwrap());
    let left_out = LeftOut { id: "2".parse().unwrap(), why: "damaged".into() };
    let mut writer = Writer::begin(&path, &Manifest::new(vec![map.name.clone()])).unwrap();
    writer.map(&map, None).unwrap();
    let line = TextLine { text: "Kawa".into(), confidence: 0.5, corners: [[0.5; 2]; 4] };
    let texts = Some(ImageTexts::read(Digest::of(b"reader"), vec![line]));
    let exported = ExportedImage { image, descriptor, position: None, recording: None, texts };
    writer.image(&map.name, &exported, &bytes).unwrap();
    writer.left_out(&map.name, &left_out).unwrap();
    let archived = ArchivedMap { name: map.name, images: 1, left_out: vec![left_out] };
    writer.finish(vec![archived]).unwrap();
    vec![std::fs::read(path).unwrap()]
}

pub fn forms() -> Vec<Vec<u8>> {
    texts(&[
        "--XX\r\nContent-Disposition: form-data; name=\"image\"; filename=\"a.jpg\"\r\n\
         Content-Type: image/jpeg\r\n\r\nbytes\r\n--XX\r\nContent-Disposition: form-data; \
         name=\"meta\"\r\n\r\n{\"id\": \"a\"}\r\n--XX--\r\n",
        "--XX\r\nContent-Disposition: form-data; name=\"image\"\r\n\r\n\r\n--XX--\r\n",
    ])
}

fn texts(all: &[&str]) -> Vec<Vec<u8>> {
    all.iter().map(|text| text.as_bytes().to_vec()).collect()
}

pub fn poses() -> Vec<Vec<u8>> {
    texts(&[
        "file,lat,lon,alt,heading\na.jpg,45.1,7.2,240.5,359.9\nb.jpg,-45,179.999,,\n",
        "file,x,y,z,qx,qy,qz,qw\na.jpg,1.5,-2,0,0,0,0.7071068,0.7071068\nb.jpg,1e3,2,,,,,\n",
        "sep=;\n# by hand\nName;Easting;Northing;Zone\nA;543250,96;4178900,7;10S\nx\\b.jpg;1;2;11N\n",
        "SourceFile;GPSLatitude;GPSLatitudeRef;GPSLongitude;GPSAltitude\na.jpg;45 deg 12' 30.00\";South;7,0,1E;24 m Below Sea Level\n",
        "file|GPSPosition|x|y|zone|hemisphere\nb.jpg|45 deg 12' 30.00\" N, 7 deg 0' 1.00\" W|1|2|33|S\n",
        r#"{"lat": 45.0, "lon": 7.0, "alt": 240.0, "heading": 90.0}"#,
        r#"{"x": 1.0, "y": -2.5, "z": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}"#,
    ])
}

pub fn truths() -> Vec<Vec<u8>> {
    texts(&[
        "query,references\na.jpg,a.jpg b.jpg\nb.jpg,\nc.jpg,c.jpg\n",
        "query,references\n\"a.jpg\",\"b.jpg\"\n",
        "query;references\na;[\"d/a b.jpg\"]\nb.jpg;d/a b.jpg \"c.jpg\"\n",
    ])
}

pub fn completions() -> Vec<Vec<u8>> {
    texts(&[
        r#"{"choices": [{"message": {"content": "<think>a</think>b"}, "finish_reason": "stop"}], "usage": {"prompt_tokens": 7}}"#,
        r#"{"choices": [{"message": {"content": [{"type": "text", "text": "a"}], "reasoning_content": "b"}}]}"#,
        "data: {\"choices\": [{\"delta\": {\"content\": \"a\"}}]}\n\ndata: [DONE]\n",
    ])
}

pub fn answers() -> Vec<Vec<u8>> {
    texts(&[
        r#"{"reasoning": "the sign", "ranking": ["C", "A", "B"]}"#,
        "Some words.\n```json\n{\"reasoning\": \"\", \"ranking\": [\"J\", \"a\", \" B \"]}\n```\nMore.",
        "I think {not this} but {\"ranking\": [\"B\"]}",
    ])
}

pub fn exif() -> Vec<Vec<u8>> {
    let degrees = |whole: u32| {
        Value::Rational(
            [(whole, 1), (30, 1), (1234, 100)].map(|(num, denom)| Rational { num, denom }).into(),
        )
    };
    let text = |letter: &str| Value::Ascii(vec![letter.as_bytes().to_vec()]);
    let fields = [
        (Tag::GPSLatitudeRef, text("S")),
        (Tag::GPSLatitude, degrees(45)),
        (Tag::GPSLongitudeRef, text("E")),
        (Tag::GPSLongitude, degrees(7)),
        (Tag::GPSAltitude, Value::Rational(vec![Rational { num: 2405, denom: 10 }])),
    ]
    .map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let (pictures, exif) = (pictures(), exif_of(&fields));
    let xmp = "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:Description xmlns:exif='http://ns.adobe.com/exif/1.0/' \
        exif:GPSLatitude='45,30.5N' exif:GPSAltitude=\"2405/10\"><exif:GPSLongitude>7,0,1E</exif:GPSLongitude>\
        <!-- a comment --></rdf:Description></x:xmpmeta>";
    let drone = "<rdf:Description xmlns:drone-dji='http://www.dji.com/drone-dji/1.0/' \
        drone-dji:GpsLatitude='+45.5' drone-dji:GpsLongitude='-7.5' drone-dji:GimbalYawDegree='-90.0'/>";
    let app1 = |packet: &str| {
        let data = [b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes()].concat();
        [&[0xFF, 0xD8, 0xFF, 0xE1][..], &(data.len() as u16 + 2).to_be_bytes(), &data].concat()
    };
    let png = |kind: &[u8], data: &[u8]| {
        let length = (data.len() as u32).to_be_bytes();
        [b"\x89PNG\r\n\x1a\n", &length[..], kind, data, &[0; 4]].concat()
    };
    let digits: String = exif.iter().map(|byte| format!("{byte:02x}")).collect();
    let profile = format!("\nexif\n{:8}\n{digits}\n", exif.len());
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(profile.as_bytes()).unwrap();
    let profile = [b"Raw profile type exif\0\0", &encoder.finish().unwrap()[..]].concat();
    let size = (xmp.len() as u32).to_le_bytes();
    vec![
        with_exif(&pictures[0], &exif),
        app1(xmp),
        app1(drone),
        png(b"eXIf", &exif),
        png(b"zTXt", &profile),
        png(b"iTXt", &[b"XML:com.adobe.xmp\0\0\0\0\0", xmp.as_bytes()].concat()),
        [b"RIFF\0\0\0\0WEBPXMP ", &size[..], xmp.as_bytes()].concat(),
        [b"GIF89a!\xFF\x0BXMP DataXMP", xmp.as_bytes()].concat(),
        [
            b"II*\0\x08\0\0\0\x01\0\xBC\x02\x01\0",
            &size[..],
            &26_u32.to_le_bytes(),
            &[0; 4],
            xmp.as_bytes(),
        ]
        .concat(),
    ]
}

fn oriented(turn: u16) -> Field {
    Field { tag: Tag::Orientation, ifd_num: In::PRIMARY, value: Value::Short(vec![turn]) }
}

fn exif_of(fields: &[Field]) -> Vec<u8> {
    let mut writer = ExifWriter::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut bytes = Cursor::new(Vec::new());
    writer.write(&mut bytes, false).unwrap();
    bytes.into_inner()
}

/// A JPEG with an EXIF segment behind its first marker.
fn with_exif(jpeg: &[u8], exif: &[u8]) -> Vec<u8> {
    let length = (exif.len() + 8) as u16;
    let head = [&[0xFF, 0xE1][..], &length.to_be_bytes(), b"Exif\0\0", exif].concat();
    [&jpeg[..2], &head, &jpeg[2..]].concat()
}
