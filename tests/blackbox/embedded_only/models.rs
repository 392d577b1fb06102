//! Models with both output layouts, from the bytes of a picture to the descriptor.

use std::path::Path;

use serde_json::Value;
use tempfile::TempDir;
use whereabouts_core::{Descriptor, DescriptorKind};
use whereabouts_vision::{Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits, Layout};

use crate::support::{BINARY, reference};

const ONE: Layout = Layout { threads: 1, sessions: 1, max_batch: 1 };
const EIGHT: Layout = Layout { threads: 1, sessions: 1, max_batch: 8 };
const SIDE_BY_SIDE: Layout = Layout { threads: 4, sessions: 2, max_batch: 2 };

fn load(model: &str, layout: Layout) -> Extractor {
    // The fixtures, and then the models that `make build` installed.
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
    let limits = ImageLimits { max_pixels: 10_000_000 };
    let settings = ExtractorSettings { layout, ..ExtractorSettings::plain(model, 1, limits) };
    Extractor::load(&Assets::locate(Some(&fixtures)), &settings).unwrap()
}

fn descriptor(extractor: &Extractor, place: usize) -> Descriptor {
    let (kind, features) = (DescriptorKind::GEM, FeatureSet::DescriptorOnly);
    extractor.extract(&reference(place), kind, features).unwrap().descriptor
}

/// The test pattern of the script that generated the fixture, as a PNG.
fn pattern() -> Vec<u8> {
    let pixels = image::RgbImage::from_fn(56, 42, |x, y| {
        let byte = |value: u32| (value % 256) as u8;
        let (r, g, b) = (7 * x + 13 * y, 11 * x + 3 * y + 50, 5 * x + 17 * y + 101);
        image::Rgb([byte(r), byte(g), byte(b)])
    });
    let mut bytes = std::io::Cursor::new(Vec::new());
    pixels.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

fn cosine(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

#[test]
fn a_token_model_gives_the_descriptors_computed_with_numpy() {
    let extractor = load("tiny-tokens", ONE);
    let file =
        concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/models/tiny-tokens/expected.json");
    let expected: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    for (kind, name) in [(DescriptorKind::CLS, "cls"), (DescriptorKind::GEM, "gem")] {
        let expected: Vec<f32> = serde_json::from_value(expected[name].clone()).unwrap();
        let extraction =
            extractor.extract(&pattern(), kind, FeatureSet::DescriptorAndDense).unwrap();
        for (got, expected) in extraction.descriptor.as_slice().iter().zip(&expected) {
            assert!((got - expected).abs() < 1e-5, "{name}: {got} is not {expected}");
        }
        let dense = extraction.dense.unwrap();
        assert_eq!((dense.height(), dense.width(), dense.channels()), (3, 4, 8));
    }
}

#[test]
fn a_batch_gives_what_single_runs_give() {
    let single = load("xfeat", ONE);
    let alone: Vec<_> = (0..8).map(|place| descriptor(&single, place)).collect();
    for layout in [EIGHT, SIDE_BY_SIDE] {
        let shared = load("xfeat", layout);
        std::thread::scope(|scope| {
            let shared = &shared;
            let extract = move |place| descriptor(shared, place);
            // Several rounds, so that pictures arrive both alone and during other batches.
            let threads: Vec<_> =
                (0..8).map(|place| scope.spawn(move || [(); 5].map(|()| extract(place)))).collect();
            for (thread, alone) in threads.into_iter().zip(&alone) {
                for together in thread.join().unwrap() {
                    let similarity = cosine(together.as_slice(), alone.as_slice());
                    assert!(similarity > 0.999_99, "{layout:?}: {similarity}");
                }
            }
        });
    }
}

#[test]
fn a_damaged_model_is_rejected_by_its_digest() {
    let root = tempfile::tempdir().unwrap();
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/models/tiny-tokens");
    let to = root.path().join("models/tiny-tokens");
    std::fs::create_dir_all(&to).unwrap();
    std::fs::copy(from.join("manifest.toml"), to.join("manifest.toml")).unwrap();
    let mut bytes = std::fs::read(from.join("model.onnx")).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(to.join("model.onnx"), bytes).unwrap();
    let settings = ExtractorSettings::plain("tiny-tokens", 1, ImageLimits { max_pixels: 1 });
    let error = Extractor::load(&Assets::locate(Some(root.path())), &settings).unwrap_err();
    assert!(error.to_string().contains("pins"), "{error}");
}

#[test]
fn a_missing_provider_is_named_at_startup() {
    let dir = TempDir::new().unwrap();
    let output = std::process::Command::new(&*BINARY)
        .args(["serve", "--listen", "127.0.0.1:0", "--data"])
        .arg(dir.path())
        .env("WHEREABOUTS_MODEL__PROVIDER", "tensorrt")
        .output()
        .unwrap();
    assert!(!output.status.success());
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("tensorrt") && said.contains("model.provider"), "{said}");
}
