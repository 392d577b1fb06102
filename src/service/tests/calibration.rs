use std::sync::Arc;
use std::time::Duration;

use super::Fixture;
use tokio_util::sync::CancellationToken;
use whereabouts_core::{Calibration, Image, Map};
use whereabouts_refine::{RefineError, Refiner};
use whereabouts_store::MapStore;

const IMAGES: usize = 6;

async fn road(fixture: &Fixture) -> Map {
    let poses: Vec<_> = (0..IMAGES).map(|number| Some(number as f64 * 100.0)).collect();
    fixture.map("road", &poses).await
}

/// What a map's calibration is after it was measured with the scripted refiner, or with none.
async fn calibrated(fixture: &Fixture, with_refiner: bool) -> Arc<Calibration> {
    let map = road(fixture).await;
    let refiner: &dyn Refiner = fixture.refiner.as_ref();
    let refiner = Some(refiner).filter(|_| with_refiner);
    fixture.service.calibrator.calibrate(&map, refiner).await.unwrap();
    fixture.store.calibration(&map).await.unwrap().unwrap()
}

#[tokio::test]
async fn without_a_refiner_similarity_alone_is_measured() {
    let fixture = Fixture::new().await;
    let measured = calibrated(&fixture, false).await;
    assert!(measured.complete);
    assert_eq!((measured.images, measured.similarity.len()), (IMAGES, IMAGES));
    assert!(measured.agreement.is_empty());
    assert!(fixture.refiner.measured.lock().is_empty());
}

#[tokio::test]
async fn what_neighbours_have_in_common_is_measured_as_far_as_a_place_reaches() {
    for (place_images, distances) in [(0, 0), (2, 2)] {
        let change = |settings: &mut crate::ServiceSettings| {
            settings.confidence.place_images = place_images;
        };
        let fixture = Fixture::with(0, change).await;
        let poses: Vec<_> = (0..40).map(|number| Some(number as f64 * 100.0)).collect();
        let map = fixture.map("road", &poses).await;
        fixture.service.calibrator.calibrate(&map, None).await.unwrap();
        let measured = fixture.store.calibration(&map).await.unwrap().unwrap();
        assert_eq!(measured.neighbours.len(), distances);
        assert!(measured.neighbours.iter().all(|weight| (0.5..=1.0).contains(weight)));
        assert!(measured.neighbours.is_sorted_by(|near, far| near > far));
    }
}

#[tokio::test(start_paused = true)]
async fn a_transient_failure_of_the_refiner_is_retried() {
    let fixture = Fixture::new().await;
    fixture.refiner.measurements.lock().extend([
        RefineError::Transient("busy".into()),
        RefineError::Deferred { why: "budget".into(), after: Duration::from_secs(1) },
    ]);
    let measured = calibrated(&fixture, true).await;
    assert!(measured.complete);
    assert_eq!(measured.agreement.len(), IMAGES);
    assert_eq!(measured.agreement.mean(), Some(0.5));
    let asked = fixture.refiner.measured.lock();
    assert_eq!(asked.len(), IMAGES + 2);
    assert!(asked[..3].iter().all(|image| *image == asked[0]), "{asked:?}");
}

#[tokio::test(start_paused = true)]
async fn an_image_on_which_the_refiner_fails_for_good_is_left_out() {
    let fixture = Fixture::new().await;
    fixture.refiner.measurements.lock().push_back(RefineError::Permanent("no picture".into()));
    let measured = calibrated(&fixture, true).await;
    assert!(measured.complete);
    assert_eq!(measured.agreement.len(), IMAGES - 1);
    assert_eq!(fixture.refiner.measured.lock().len(), IMAGES);
}

#[tokio::test]
async fn a_model_is_not_asked_unless_calls_are_allowed() {
    let fixture = Fixture::with(0, |settings| settings.confidence.model_calls = 0).await;
    let measured = calibrated(&fixture, true).await;
    assert_eq!((measured.model_asked, measured.verdict.len()), (0, IMAGES));
    assert_eq!(measured.verdict.mean(), Some(0.5));
    assert_eq!(*fixture.refiner.verdicts.lock(), 0);
}

#[tokio::test]
async fn a_model_is_asked_about_as_many_images_as_the_calls_go_round() {
    // A map of 6 images is too small: fewer than nine verdicts calibrate nothing.
    let fixture = Fixture::with(0, |settings| settings.confidence.model_calls = 1000).await;
    assert_eq!(calibrated(&fixture, true).await.model_asked, 0);
    assert_eq!(*fixture.refiner.verdicts.lock(), 0);
    // At 6 calls an image, 70 calls go round for 11.
    let fixture = Fixture::with(0, |settings| settings.confidence.model_calls = 70).await;
    let poses: Vec<_> = (0..40).map(|number| Some(number as f64 * 100.0)).collect();
    let map = fixture.map("road", &poses).await;
    fixture.service.calibrator.calibrate(&map, Some(fixture.refiner.as_ref())).await.unwrap();
    let measured = fixture.store.calibration(&map).await.unwrap().unwrap();
    let verdicts = *fixture.refiner.verdicts.lock();
    assert!((9..=11).contains(&verdicts), "{verdicts}");
    assert_eq!((measured.model_asked, measured.verdict.len()), (verdicts, verdicts));
    assert_eq!(measured.verdict.mean(), Some(-2.0));
}

#[test]
fn too_few_calls_to_calibrate_a_model_are_refused_with_the_number_that_is_enough() {
    let settings = |model_calls| crate::ConfidenceSettings {
        images: 100,
        refined: 100,
        place_images: 0,
        place_m: 5.0,
        model_calls,
    };
    assert_eq!(settings(0).validate(10), None);
    assert_eq!(settings(99).validate(10), None);
    assert!(settings(98).validate(10).unwrap().contains("at least 99"));
}

#[tokio::test]
async fn at_most_the_configured_number_of_images_is_refined() {
    let fixture = Fixture::with(0, |settings| settings.confidence.refined = 2).await;
    let measured = calibrated(&fixture, true).await;
    assert_eq!((measured.similarity.len(), measured.agreement.len()), (IMAGES, 2));
}

#[tokio::test(start_paused = true)]
async fn a_map_is_calibrated_again_once_a_fifth_of_its_poses_has_changed() {
    let fixture = Fixture::new().await;
    let map = road(&fixture).await;
    let images = fixture.store.images(&map, None, IMAGES).await.unwrap();
    let shutdown = CancellationToken::new();
    let move_image = async |index: usize| {
        let moved = Image { pose: None, ..images[index].clone() };
        assert!(fixture.store.replace_image(&map, &images[index], moved).await.unwrap());
    };
    let moved_at_calibration = async || {
        // Longer than the longest pause between two scans.
        tokio::time::sleep(Duration::from_secs(60)).await;
        let calibration = fixture.store.calibration(&map).await.unwrap().unwrap();
        assert!(calibration.complete);
        calibration.moved
    };
    let changing = async {
        assert_eq!(moved_at_calibration().await, 0);
        move_image(0).await;
        assert_eq!(moved_at_calibration().await, 0);
        move_image(1).await;
        assert_eq!(moved_at_calibration().await, 2);
        shutdown.cancel();
    };
    tokio::join!(fixture.service.calibrator.run(shutdown.clone()), changing);
}
