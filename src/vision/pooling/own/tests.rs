use std::path::Path;

use super::*;
use crate::Manifest;
use crate::pooling::Kinds;

fn own() -> OwnVocabulary {
    let text = include_str!("../../../../deploy/models/xfeat.toml");
    let manifest = Manifest::parse(text, Path::new("manifest.toml")).unwrap();
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/models");
    let kinds = Kinds::load(&manifest, Path::new(folder)).unwrap();
    OwnVocabulary::new(kinds.vocabulary("vlad".parse().unwrap()).unwrap()).unwrap()
}

/// Pictures that have half of their numbers in common, and differ in random others, which the fit does not use.
fn pictures(range: std::ops::Range<usize>, length: usize) -> Vec<Vec<f32>> {
    const UNUSED: usize = 10_000;
    let picture = |k: usize| {
        let sum = |row| sign(UNUSED, row) + sign(UNUSED + 1 + k, row);
        let numbers: Vec<f32> = (0..length).map(sum).collect();
        let scale = 1.0 / norm(&numbers);
        numbers.into_iter().map(|x| x * scale).collect()
    };
    range.map(picture).collect()
}

fn cosines(of: &Vocabulary, a: &[f32], b: &[f32]) -> (f32, f32) {
    let (x, y) = (of.describe(a).unwrap(), of.describe(b).unwrap());
    (dot(a, b), x.similarity(&y))
}

#[test]
fn cosines_between_the_images_of_the_map_are_kept_and_those_of_others_are_right_on_average() {
    let own = own();
    let length = own.expanding.settings.dimension;
    let (inside, outside) = (pictures(0..24, length), pictures(100..124, length));
    let slices: Vec<&[f32]> = inside.iter().map(Vec::as_slice).collect();
    let fitted = own.fit(&slices).unwrap();
    assert_eq!(fitted.describe(&inside[0]).unwrap().dim(), 512);
    let (mut within, mut across) = (0.0, 0.0);
    for k in 1..24 {
        // Slightly less, because whitening reduces what all have in common.
        let (before, after) = cosines(&fitted, &inside[0], &inside[k]);
        assert!((before - 0.5).abs() < 0.06 && (0.3..before + 0.02).contains(&after), "{after}");
        within += after / 23.0;
        across += cosines(&fitted, &inside[0], &outside[k]).1 / 23.0;
    }
    assert!((within - across).abs() < 0.04, "{across} instead of {within}");
}

#[test]
fn a_vocabulary_is_read_as_it_was_written() {
    let own = own();
    let pictures = pictures(0..8, own.expanding.settings.dimension);
    let slices: Vec<&[f32]> = pictures.iter().map(Vec::as_slice).collect();
    let fitted = own.fit(&slices).unwrap();
    let bytes = fitted.to_bytes();
    assert_eq!(own.read(&bytes).unwrap(), fitted);
    let error = own.read(&bytes[2..]).unwrap_err();
    assert!(error.contains("bytes"), "{error}");
}

#[test]
fn a_model_whose_descriptor_has_no_projection_has_no_own_vocabulary() {
    let model = own().expanding;
    assert!(OwnVocabulary::new(&model).is_none());
}

#[test]
fn images_without_features_are_an_error() {
    let own = own();
    let blank = vec![0.0; own.expanding.settings.dimension];
    assert!(own.fit(&[&blank, &blank]).is_err());
    assert!(own.fit(&[]).is_err());
}
