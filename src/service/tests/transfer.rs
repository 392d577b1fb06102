use super::{DIM, Fixture, descriptor, image, map, metric};
use crate::{ServiceError, Transfer};
use whereabouts_api::{ErrorKind, ImportedImage, ImportedMap};
use whereabouts_core::{
    CoordinateFrame, Descriptor, ExportedImage, GeographicPose, Map, MapName, MediaType, Pose,
};
use whereabouts_store::Added;
use whereabouts_vision::AdmissionRequest;

fn yard() -> MapName {
    "yard".parse().unwrap()
}

/// The first image of another store, as that exports it.
fn exported() -> (Vec<u8>, ImportedImage) {
    let (bytes, image) = image(0, Some(1.0));
    let image = ExportedImage {
        image,
        descriptor: Some(descriptor(0)),
        position: None,
        recording: None,
        texts: None,
    };
    (bytes, ImportedImage { map: map("other"), image })
}

async fn import(
    transfer: &Transfer,
    (bytes, from): (Vec<u8>, ImportedImage),
) -> Result<Added, ServiceError> {
    transfer.import_image(&yard(), from, bytes.into(), AdmissionRequest::BACKGROUND).await
}

#[tokio::test]
async fn a_map_is_imported_once_and_never_over_images_of_another_model() {
    let fixture = Fixture::new().await;
    let transfer = &fixture.service.transfer;
    let (state, new) =
        transfer.import_map(&yard(), without_vocabulary(map("other"))).await.unwrap();
    assert_eq!((state.name, state.dim, new), (yard(), DIM, true));
    assert!(!transfer.import_map(&yard(), without_vocabulary(map("other"))).await.unwrap().1);
    assert!(matches!(import(transfer, exported()).await.unwrap(), Added::Created(_)));
    assert!(matches!(import(transfer, exported()).await.unwrap(), Added::Present(_)));
    for different in [
        Map { model: "another".into(), ..map("other") },
        Map { frame: CoordinateFrame::Wgs84, ..map("other") },
        Map { dim: DIM + 1, ..map("other") },
    ] {
        let refused =
            transfer.import_map(&yard(), without_vocabulary(different.clone())).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Conflict, "{different:?}");
        let (bytes, from) = exported();
        let refused = import(transfer, (bytes, ImportedImage { map: different, ..from })).await;
        assert_eq!(refused.unwrap_err().kind, ErrorKind::Conflict);
    }
}

#[tokio::test]
async fn a_map_that_no_server_can_have_made_is_not_imported() {
    let fixture = Fixture::new().await;
    for from in [
        Map { model: "../escape".into(), ..map("other") },
        Map { model: ".hidden".into(), ..map("other") },
        Map { model: String::new(), ..map("other") },
        Map { dim: 0, ..map("other") },
        Map { dim: (1 << 16) + 1, ..map("other") },
        Map { description: Some("x".repeat(2001)), ..map("other") },
    ] {
        let refused =
            fixture.service.transfer.import_map(&yard(), without_vocabulary(from.clone())).await;
        assert_eq!(refused.unwrap_err().kind, ErrorKind::Unprocessable, "{from:?}");
    }
    assert!(fixture.service.maps.list().await.unwrap().is_empty());
}

#[tokio::test]
async fn an_image_that_contradicts_its_bytes_or_its_map_is_not_imported() {
    let fixture = Fixture::new().await;
    let transfer = &fixture.service.transfer;
    transfer.import_map(&yard(), without_vocabulary(map("other"))).await.unwrap();
    let on_the_globe =
        Pose::Geographic(GeographicPose { lat: 1.0, lon: 2.0, alt: None, heading: None });
    let short = Descriptor::normalised(vec![1.0; DIM - 1]).unwrap();
    type Change = fn(&mut (Vec<u8>, ImportedImage));
    let digest: Change = |(bytes, _)| bytes.push(0);
    let media_type: Change = |(_, from)| from.image.image.media_type = MediaType::Png;
    let tags: Change = |(_, from)| from.image.image.tags = vec![String::new()];
    let pose: Change = |(_, from)| from.image.image.pose = Some(metric(f64::NAN));
    for (change, why) in
        [(digest, "digest"), (media_type, "media type"), (tags, "tags"), (pose, "")]
    {
        let mut changed = exported();
        change(&mut changed);
        let refused = import(transfer, changed).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Unprocessable, "{refused}");
        assert!(refused.detail.contains(why), "{refused}");
    }
    let mut foreign = exported();
    foreign.1.image.image.pose = Some(on_the_globe);
    let refused = import(transfer, foreign).await.unwrap_err();
    assert!(refused.detail.contains("frame"), "{refused}");
    let mut other_dimension = exported();
    other_dimension.1.image.descriptor = Some(short);
    let refused = import(transfer, other_dimension).await.unwrap_err();
    assert!(refused.detail.contains("has 3") && refused.detail.contains('4'), "{refused}");
    assert_eq!(fixture.service.maps.get(&yard()).await.unwrap().images, 0);
}

#[tokio::test]
async fn an_exported_map_is_the_map_that_was_imported() {
    let fixture = Fixture::new().await;
    let transfer = &fixture.service.transfer;
    fixture.map("source", &[Some(0.0), None, Some(2.0)]).await;
    let source = "source".parse().unwrap();
    let mut cursor = None;
    let mut count = 0;
    loop {
        let page = transfer.export(&source, cursor.as_ref(), Some(2)).await.unwrap();
        transfer.import_map(&yard(), without_vocabulary(page.map.clone())).await.unwrap();
        for image in page.images {
            let bytes = super::image(count, None).0;
            import(transfer, (bytes, ImportedImage { map: page.map.clone(), image }))
                .await
                .unwrap();
            count += 1;
        }
        let Some(next) = page.next_cursor else { break };
        cursor = Some(next.parse().unwrap());
    }
    assert_eq!(count, 3);
    let copy = transfer.export(&yard(), None, None).await.unwrap();
    let original = transfer.export(&source, None, None).await.unwrap();
    for (copy, original) in copy.images.iter().zip(&original.images) {
        assert_eq!(copy.descriptor, original.descriptor);
        assert_eq!((&copy.image.id, copy.image.pose), (&original.image.id, original.image.pose));
    }
}

fn without_vocabulary(map: Map) -> ImportedMap {
    ImportedMap { map, vocabulary_data: None }
}
