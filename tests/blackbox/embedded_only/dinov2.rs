//! DINOv2 from the bytes of a JPEG to the descriptor, against PyTorch, torchvision and transformers.
//!
//! The weights are seeded random numbers, generated for each run: the real ones are hundreds of
//! megabytes and prove nothing more about the arithmetic. `deploy/models/reference_dinov2.py` computed
//! the expected descriptors in Python, from the same weights and the same pictures.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde::Deserialize;
use tempfile::TempDir;
use whereabouts_core::DescriptorKind;
use whereabouts_vision::{Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits, Layout};

/// The minimum cosine similarity to the descriptor of the original.
const SAME: f64 = 0.9999;

/// The minimum for the 8-bit quantized variant.
const NEAR: f64 = 0.995;

#[derive(Deserialize)]
struct Expected {
    model: String,
    seed: u32,
    width: u32,
    height: u32,
    resize: String,
    /// What of which block the descriptor is of; empty for the last tokens.
    facet: String,
    kind: DescriptorKind,
    picture: String,
    vector: Vec<f32>,
}

fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Exports the ONNX file and the manifest of a model with random weights.
fn export(model: &str, seed: u32, options: &[&str], folder: &Path) {
    let packages = std::fs::read_to_string(repository().join("assets/.python"))
        .expect("run `make assets` first: it gets the Python packages that this needs");
    let (python, packages) = packages.trim().split_once('\n').unwrap();
    let output = Command::new(python)
        .env("PYTHONPATH", packages)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .arg(repository().join("deploy/models/export_dinov2.py"))
        .args([model, folder.to_str().unwrap(), "--position", "hub", "--random"])
        .arg(seed.to_string())
        .args(options)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Creates a model folder with another input size, which shares the ONNX file.
fn with_input(root: &Path, exported: &Path, expected: &Expected) -> PathBuf {
    let name = format!("{}-{}-{}", expected.width, expected.height, expected.resize);
    let folder = root.join("models").join(&name);
    if !folder.exists() {
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::hard_link(exported.join("model.onnx"), folder.join("model.onnx")).unwrap();
        let text = std::fs::read_to_string(exported.join("manifest.toml")).unwrap();
        let mut manifest: toml::Table = text.parse().unwrap();
        let input = manifest["input"].as_table_mut().unwrap();
        input.insert("width".into(), i64::from(expected.width).into());
        input.insert("height".into(), i64::from(expected.height).into());
        input.insert("resize".into(), expected.resize.clone().into());
        if !expected.facet.is_empty() {
            std::fs::copy(vocabulary(), folder.join("vlad.bin")).unwrap();
            let channels = manifest["output"]["channels"].as_integer().unwrap();
            let centres = std::fs::metadata(vocabulary()).unwrap().len() as i64 / 2 / channels;
            let descriptors = toml::toml! { vlad = { method = "vlad", file = "vlad.bin", rows = 1, weighting = "none" } };
            let mut vlad = descriptors["vlad"].as_table().unwrap().clone();
            vlad.insert("centres".into(), centres.into());
            vlad.insert("dimension".into(), (centres * channels).into());
            let kinds = toml::Table::from_iter([("vlad".to_owned(), vlad.into())]);
            manifest.insert("descriptors".into(), kinds.into());
        }
        std::fs::write(folder.join("manifest.toml"), manifest.to_string()).unwrap();
    }
    folder
}

/// The centres of `vlad`, as the reference chose them.
fn vocabulary() -> PathBuf {
    repository().join("tests/fixtures/dinov2/vlad.bin")
}

/// Compares the descriptors of a model with all that are expected of it.
fn check(model: &str, options: &[&str], minimum: f64) {
    check_facet(model, "", options, minimum);
}

/// Compares the descriptors of what a block computes, written as `value-7`.
fn check_facet(model: &str, facet: &str, options: &[&str], minimum: f64) {
    let fixtures = repository().join("tests/fixtures/dinov2");
    let text = std::fs::read_to_string(fixtures.join("expected.json")).unwrap();
    let mut expected: Vec<Expected> = serde_json::from_str(&text).unwrap();
    expected.retain(|expected| expected.model == model && expected.facet == facet);
    assert!(!expected.is_empty());
    let root = TempDir::new().unwrap();
    let exported = root.path().join("exported");
    export(model, expected[0].seed, options, &exported);
    let mut by_input: BTreeMap<PathBuf, Vec<Expected>> = BTreeMap::new();
    for expected in expected {
        by_input.entry(with_input(root.path(), &exported, &expected)).or_default().push(expected);
    }
    let mut least = BTreeMap::new();
    for (folder, expected) in &by_input {
        let name = folder.file_name().unwrap().to_str().unwrap();
        let limits = ImageLimits { max_pixels: 10_000_000 };
        let layout = Layout { threads: 2, sessions: 1, max_batch: 8 };
        let settings = ExtractorSettings { layout, ..ExtractorSettings::plain(name, 2, limits) };
        let extractor = Extractor::load(&Assets::locate(Some(root.path())), &settings).unwrap();
        // Each runs twice at once: a descriptor must not depend on its batch.
        std::thread::scope(|scope| {
            let running: Vec<_> = expected
                .iter()
                .flat_map(|expected| [expected, expected])
                .map(|expected| {
                    let (extractor, fixtures) = (&extractor, &fixtures);
                    scope.spawn(move || {
                        let picture = std::fs::read(fixtures.join(&expected.picture)).unwrap();
                        let features = FeatureSet::DescriptorOnly;
                        let extraction =
                            extractor.extract(&picture, expected.kind, features).unwrap();
                        (cosine(extraction.descriptor.as_slice(), &expected.vector), expected)
                    })
                })
                .collect();
            for running in running {
                let (similarity, expected) = running.join().unwrap();
                assert!(
                    similarity >= minimum,
                    "{model} {name} {} {}: cosine {similarity:.7}",
                    expected.kind,
                    expected.picture
                );
                let least = least.entry(&expected.picture).or_insert(similarity);
                *least = similarity.min(*least);
            }
        });
    }
    eprintln!("{model} {options:?}: the least cosines to transformers are {least:.6?}");
}

fn cosine(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let dot = |a: &[f32], b: &[f32]| -> f64 {
        a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    };
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}

#[test]
fn the_small_model_equals_the_original() {
    check("dinov2-small", &[], SAME);
}

#[test]
fn the_base_model_equals_the_original() {
    check("dinov2-base", &[], SAME);
}

#[test]
fn the_small_model_with_registers_equals_the_original() {
    check("dinov2-with-registers-small", &[], SAME);
}

#[test]
fn what_a_block_computes_equals_the_original_and_so_does_its_vlad() {
    for (model, name) in [
        ("dinov2-small", "value"),
        ("dinov2-small", "key"),
        ("dinov2-small", "token"),
        ("dinov2-with-registers-small", "value"),
    ] {
        check_facet(model, &format!("{name}-7"), &["--facet", name, "--layer", "7"], SAME);
    }
}

#[test]
fn the_small_model_in_8_bits_is_near_the_original() {
    check("dinov2-small", &["--int8"], NEAR);
}
