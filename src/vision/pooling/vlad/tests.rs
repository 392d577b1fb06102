//! VLAD against an independent implementation: `deploy/models/reference_vlad.py`, in numpy.

use std::path::PathBuf;

use serde::Deserialize;
use whereabouts_core::Descriptor;

use super::*;
use crate::manifest::{Layout, Output};

#[derive(Deserialize)]
struct Case {
    descriptor: Vlad,
    layout: Layout,
    height: usize,
    width: usize,
    channels: usize,
    registers: usize,
    output: Vec<f32>,
    reliability: Vec<f32>,
    expected: Vec<f32>,
}

fn folder() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/fixtures/vlad"))
}

fn case(name: &str) -> Case {
    let text = std::fs::read_to_string(folder().join(name).with_extension("json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

impl Case {
    fn features(&self) -> LocalFeatures {
        let output = Output {
            features: "features".into(),
            layout: self.layout,
            reliability: Some("reliability".into()),
            channels: self.channels,
            stride: 8,
            registers: self.registers,
            cls: self.layout == Layout::Tokens,
        };
        let cells = (self.height, self.width);
        LocalFeatures::from_output(&output, cells, &self.output, Some(&self.reliability)).unwrap()
    }

    fn vocabulary(&self) -> Vocabulary {
        let path = folder().join(&self.descriptor.file);
        Vocabulary::read(&path, &self.descriptor, self.channels).unwrap()
    }
}

#[test]
fn descriptors_equal_those_computed_with_numpy() {
    for name in ["anyloc", "hard", "soft", "short", "projected"] {
        let case = case(name);
        let numbers = case.vocabulary().aggregate(&case.features());
        let descriptor = Descriptor::normalised(numbers).unwrap();
        assert_eq!(descriptor.dim(), case.descriptor.dimension, "{name}");
        let expected = Descriptor::normalised(case.expected).unwrap();
        let cosine = descriptor.similarity(&expected);
        assert!(cosine > 0.999_99, "{name}: {cosine}");
        for (got, expected) in descriptor.as_slice().iter().zip(expected.as_slice()) {
            assert!((got - expected).abs() < 1e-4, "{name}: {got} is not {expected}");
        }
    }
}

#[test]
fn a_picture_without_reliable_cells_has_a_descriptor() {
    let case = case("short");
    let features = LocalFeatures { reliability: Some(vec![0.0; 42]), ..case.features() };
    let numbers = case.vocabulary().aggregate(&features);
    assert!(Descriptor::normalised(numbers).is_ok());
}

#[test]
fn a_vocabulary_that_is_not_what_the_manifest_declares_is_refused() {
    let case = case("short");
    let path = folder().join(&case.descriptor.file);
    for changed in [
        Vlad { centres: 16, ..case.descriptor.clone() },
        Vlad { rows: 1, ..case.descriptor.clone() },
        Vlad { block: None, ..case.descriptor.clone() },
        Vlad { dimension: 12, ..case.descriptor.clone() },
    ] {
        let error = Vocabulary::read(&path, &changed, case.channels).unwrap_err();
        assert!(error.contains("bytes"), "{error}");
    }
    let other = Vlad { file: "missing.bin".into(), ..case.descriptor };
    assert!(Vocabulary::read(&folder().join(&other.file), &other, case.channels).is_err());
    let broken = tempfile::NamedTempFile::new().unwrap();
    let mut bytes = std::fs::read(path).unwrap();
    bytes[1] = 0x7c; // the high byte of infinity
    bytes[0] = 0;
    std::fs::write(broken.path(), bytes).unwrap();
    let error = Vocabulary::read(broken.path(), &other, case.channels).unwrap_err();
    assert!(error.contains("finite"), "{error}");
}
