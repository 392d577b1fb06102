use bytes::Bytes;

use super::{Fixture, descriptor, image, metric};
use crate::{NewImage, ServiceError};
use whereabouts_api::{ErrorKind, ImageAnswer, ImageMeta};
use whereabouts_core::{Digest, Image, ImageField, MediaType};
use whereabouts_store::{BlobStore, MapStore};
use whereabouts_vision::AdmissionRequest;

/// A picture of four pixels.
const PICTURE: &[u8] = b"P5 2 2 255\n\x01\x02\x03\x04";

async fn add(
    fixture: &Fixture,
    bytes: &'static [u8],
    meta: serde_json::Value,
) -> Result<(ImageAnswer, bool), ServiceError> {
    let meta: ImageMeta = serde_json::from_value(meta).unwrap();
    let bytes = Bytes::from_static(bytes);
    let new = NewImage { bytes, meta, demand: AdmissionRequest::BACKGROUND };
    fixture.service.images.add(&"yard".parse().unwrap(), new).await
}

#[tokio::test]
async fn an_image_with_the_same_bytes_is_answered_without_a_model() {
    // The model is not installed, so nothing can be extracted.
    let fixture = Fixture::new().await;
    let map = fixture.map("yard", &[]).await;
    let digest = Digest::of(PICTURE);
    let (_, stored) = image(0, Some(1.0));
    let stored = Image { digest, media_type: MediaType::Pnm, ..stored };
    let _pin = fixture.store.put_blob(digest, PICTURE.into()).await.unwrap();
    fixture.store.add_image(&map, stored, descriptor(0)).await.unwrap();

    let same = serde_json::json!({"id": "image-0"});
    let (answer, is_new) = add(&fixture, PICTURE, same.clone()).await.unwrap();
    assert_eq!((answer.image.pose, is_new), (Some(metric(1.0)), false));
    assert!(answer.changed.is_empty());
    let moved = serde_json::json!({"id": "image-0", "pose": {"x": 2.0, "y": 0.0}});
    let (answer, is_new) = add(&fixture, PICTURE, moved).await.unwrap();
    assert_eq!((answer.image.pose, is_new), (Some(metric(2.0)), false));
    assert_eq!(answer.changed, [ImageField::Pose]);
    let wrong = serde_json::json!({"id": "image-0", "pose": {"lat": 2.0, "lon": 0.0}});
    let refused = add(&fixture, PICTURE, wrong).await.unwrap_err();
    assert_eq!(refused.kind, ErrorKind::Unprocessable);

    for (bytes, id) in [(PICTURE, "image-1"), (b"P5 2 2 255\n\x01\x02\x03\x05", "image-0")] {
        let refused = add(&fixture, bytes, serde_json::json!({"id": id})).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Conflict, "{refused}");
        assert!(refused.detail.contains("not-installed"), "{refused}");
    }
}
