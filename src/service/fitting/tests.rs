use super::*;
use crate::tests::map;

const SETTINGS: VocabularySettings =
    VocabularySettings { own: true, min_images: 10, max_images: 20, loaded: 1 };

#[test]
fn a_map_says_why_it_keeps_the_vocabulary_of_the_model() {
    let reason = |images, settings: VocabularySettings, map: &Map| obstacle(map, images, &settings);
    let plain = map("m");
    assert_eq!(reason(10, SETTINGS, &plain), None);
    assert_eq!(reason(20, SETTINGS, &plain), None);
    assert!(reason(9, SETTINGS, &plain).unwrap().contains("min_images"));
    assert!(reason(21, SETTINGS, &plain).unwrap().contains("max_images"));
    let off = VocabularySettings { own: false, ..SETTINGS };
    assert!(reason(10, off, &plain).unwrap().contains("off"));
    let keeps = Map { keeps_shipped: true, ..plain };
    assert!(reason(10, SETTINGS, &keeps).unwrap().contains("shipped"));
}

#[test]
fn of_equally_similar_images_the_first_is_the_nearest() {
    let similarities = [0.5, 0.7, 0.7, f32::MIN];
    let sample = || Sample {
        image: crate::tests::image(0, None).1,
        shipped: crate::tests::descriptor(0),
        expanded: Vec::new(),
    };
    let samples: Vec<Sample> = similarities.iter().map(|_| sample()).collect();
    let others: Vec<&Sample> = samples.iter().collect();
    assert_eq!(nearest(&others, |_, at| Some(similarities[at])), Some(1));
    assert_eq!(nearest(&others, |_, at| (at == 3).then_some(0.0)), Some(3));
    assert_eq!(nearest(&others, |_, _| None), None);
}
