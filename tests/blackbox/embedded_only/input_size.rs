//! The size at which a model gets its pictures: the manifest's, or that of a setting, for files as the model hub has
//! them.
//!
//! `deploy/models/make_tiny_hub.py` made the files with the exporter of the hub, and computed what PyTorch gives.

use std::path::{Path, PathBuf};

use serde_json::Value;
use whereabouts_core::DescriptorKind;
use whereabouts_vision::{
    Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits, InputSizes,
};

use super::model_files::{Bench, Outcome};
use crate::mock_hub::Hub;

const HUB: &str = "http://127.0.0.1:9";

fn fixture(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/models/tiny-hub").join(file)
}

fn sized(width: u64, height: u64) -> InputSizes {
    InputSizes::try_from(vec![format!("tiny-hub={width}x{height}")]).unwrap()
}

fn load(sizes: InputSizes) -> Extractor {
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
    let assets = Assets::locate(Some(&fixtures)).with_sizes(sizes);
    let limits = ImageLimits { max_pixels: 10_000_000 };
    Extractor::load(&assets, &ExtractorSettings::plain("tiny-hub", 1, limits)).unwrap()
}

/// The picture of the script that made the fixture, as a PNG.
fn pattern(width: u32, height: u32) -> Vec<u8> {
    let pixels = image::RgbImage::from_fn(width, height, |x, y| {
        let byte = |value: u32| (value % 256) as u8;
        image::Rgb([byte(7 * x + 13 * y), byte(11 * x + 3 * y + 50), byte(5 * x + 17 * y + 101)])
    });
    let mut bytes = std::io::Cursor::new(Vec::new());
    pixels.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

#[track_caller]
fn assert_near(got: &[f32], expected: &Value, what: &str) {
    let expected: Vec<f32> = serde_json::from_value(expected.clone()).unwrap();
    assert_eq!(got.len(), expected.len());
    for (got, expected) in got.iter().zip(&expected) {
        assert!((got - expected).abs() < 1e-4, "{what}: {got} is not {expected}");
    }
}

#[test]
fn a_file_of_the_hub_gives_what_pytorch_gives_at_every_size_and_shape() {
    let text = std::fs::read_to_string(fixture("expected.json")).unwrap();
    let expected: Vec<Value> = serde_json::from_str(&text).unwrap();
    let mut digests = Vec::new();
    for expected in &expected {
        let edge = |name: &str| expected[name].as_u64().unwrap();
        let (width, height) = (edge("width"), edge("height"));
        let what = format!("{width}×{height}");
        let extractor = load(sized(width, height));
        let picture = pattern(width as u32, height as u32);
        for (kind, name) in [(DescriptorKind::CLS, "cls"), (DescriptorKind::GEM, "gem")] {
            let features = FeatureSet::DescriptorAndDense;
            let extraction = extractor.extract(&picture, kind, features).unwrap();
            assert_near(extraction.descriptor.as_slice(), &expected[name], &what);
            let dense = extraction.dense.unwrap();
            assert_eq!((dense.width() as u64, dense.height() as u64), (width / 14, height / 14));
            let last = dense.len() - 1;
            for (name, cell) in [("first", 0), ("middle", dense.len() / 2), ("last", last)] {
                let cell = &dense.cells()[cell * dense.channels()..][..dense.channels()];
                assert_near(cell, &expected[name], &format!("{what}, {name} patch"));
            }
        }
        digests.push(extractor.digest(DescriptorKind::GEM).unwrap());
    }
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), expected.len(), "each size has an identity of its own");
}

#[test]
fn the_whole_picture_decides_whatever_its_shape() {
    let extractor = load(InputSizes::default());
    let descriptor = |pixels: &image::RgbImage| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        pixels.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        let (kind, features) = (DescriptorKind::GEM, FeatureSet::DescriptorOnly);
        extractor.extract(&bytes.into_inner(), kind, features).unwrap().descriptor
    };
    // A landscape frame, a portrait one, a panorama and a strip: what is at its ends is seen.
    for (width, height) in [(640, 480), (480, 640), (1600, 200), (40, 1200), (322, 322)] {
        let plain = image::RgbImage::from_fn(width, height, |x, y| {
            image::Rgb([(x * 255 / width) as u8, (y * 255 / height) as u8, 90])
        });
        let ends = image::RgbImage::from_fn(width, height, |x, y| {
            let along = if width > height {
                f64::from(x) / f64::from(width)
            } else {
                f64::from(y) / f64::from(height)
            };
            let is_end = !(0.1..0.9).contains(&along);
            if is_end { image::Rgb([255, 255, 255]) } else { *plain.get_pixel(x, y) }
        });
        let (plain, ends) = (descriptor(&plain), descriptor(&ends));
        let cosine: f32 = plain.as_slice().iter().zip(ends.as_slice()).map(|(a, b)| a * b).sum();
        assert!(cosine < 0.9999, "{width}×{height}: {cosine}");
    }
}

/// Adds a file of the fixture with its manifest, whose pinned digest is left out.
fn add(bench: &Bench, file: &str, sizes: &str) -> Outcome {
    let text = std::fs::read_to_string(fixture("manifest.toml")).unwrap();
    let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
    let manifest = bench.catalogue().with_file_name("given.toml");
    std::fs::write(&manifest, unpinned.join("\n")).unwrap();
    let (file, manifest) = (fixture(file), manifest.to_str().unwrap().to_owned());
    let mut command = bench.command(HUB, &["add", file.to_str().unwrap(), "--manifest", &manifest]);
    if !sizes.is_empty() {
        command.env("WHEREABOUTS_MODEL__SIZES", sizes);
    }
    Outcome::of(&command.output().unwrap())
}

#[test]
fn a_file_that_takes_one_size_only_is_refused_with_the_size_that_it_takes() {
    let bench = Bench::new();
    add(&bench, "frozen.onnx", "").bad(&[
        "224×224 pixels only",
        "although it declares any size",
        "\"tiny-hub\" is to get 322×322",
        "input.width = 224",
        "model.sizes = [\"tiny-hub=224x224\"]",
        "export_dinov2.py",
    ]);
    add(&bench, "frozen.onnx", "tiny-hub=518x518").bad(&["is to get 518×518"]);
    assert!(!bench.models().join("tiny-hub").exists());
    // The setting that the message names, with which it is used from then on.
    add(&bench, "frozen.onnx", "[\"tiny-hub=224x224\"]").good();
    bench.run(HUB, &["verify", "tiny-hub"]).bad(&["tiny-hub"]);
    let mut verify = bench.command(HUB, &["verify", "tiny-hub"]);
    verify.env("WHEREABOUTS_MODEL__SIZES", "[\"tiny-hub=224x224\"]");
    Outcome::of(&verify.output().unwrap()).good();
    let shown = bench.run(HUB, &["show", "tiny-hub"]).good();
    assert!(shown.contains("the whole picture, stretched to 322×322"), "{shown}");
}

#[test]
fn a_size_that_the_model_cannot_take_says_which_ones_it_can() {
    let bench = Bench::new();
    for (sizes, words) in [
        ("[\"tiny-hub=320x322\"]", &["tiny-hub=320x322", "multiple of 14", "308 or 322"][..]),
        ("[\"tiny-hub=322x0\"]", &["input.height = 0", "such as 14"]),
        ("[\"tiny-hub=5000x322\"]", &["up to 4096", "such as 4088"]),
        ("[\"tiny-hub\"]", &["MODEL=WIDTHxHEIGHT", "dinov2-small=322x322"]),
        ("[\"tiny-hub=14x14\",\"tiny-hub=28x28\"]", &["two sizes"]),
    ] {
        add(&bench, "model.onnx", sizes).bad(words);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_whole_picture_of_a_new_release_is_adopted_when_it_is_asked_for() {
    let (before, after) = (Bench::new(), Bench::with(|old| old.replace("centre_crop", "squash")));
    let hub =
        Hub::start(std::fs::read(super::model_files::fixture("model.onnx")).unwrap(), &[]).await;
    let pull = || {
        let mut command = before.command(&hub.url, &["pull", "tiny"]);
        tokio::task::spawn_blocking(move || command.output().unwrap())
    };
    Outcome::of(&pull().await.unwrap()).good();
    let manifest = before.models().join("tiny/manifest.toml");
    assert!(std::fs::read_to_string(&manifest).unwrap().contains("centre_crop"));
    // A new release comes with another catalogue.
    std::fs::copy(after.catalogue(), before.catalogue()).unwrap();
    let said = Outcome::of(&pull().await.unwrap()).good();
    assert!(said.contains("takes a centre crop of 56×42"), "{said}");
    assert!(said.contains("pull tiny --update"), "{said}");
    assert!(std::fs::read_to_string(&manifest).unwrap().contains("centre_crop"));
    let said = before.run(HUB, &["pull", "tiny", "--update"]).good();
    assert!(said.contains("took a centre crop of 56×42, and takes the whole picture"), "{said}");
    assert!(said.contains("index --reindex"), "{said}");
    assert!(std::fs::read_to_string(&manifest).unwrap().contains("squash"));
    before.run(HUB, &["verify", "tiny"]).good();
    let said = before.run(HUB, &["pull", "tiny", "--update"]).good();
    assert!(said.contains("up to date"), "{said}");
    assert_eq!(hub.requested_paths().len(), 1, "the file is not downloaded again");
}
