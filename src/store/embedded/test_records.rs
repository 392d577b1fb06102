//! Records that the tests of this store share.

use std::path::Path;
use std::time::Duration;

use jiff::Timestamp;
use uuid::Uuid;

use super::{DescriptionBounds, EmbeddedSettings};
use whereabouts_core::{
    CoordinateFrame, DescriptorKind, Digest, Image, Map, MediaType, Precision, Scene,
};
use whereabouts_index::IndexSettings;

/// Settings of a small store.
pub fn settings(dir: &Path) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            exact_up_to: 4,
            m: 8,
            ef_construction: 50,
            ef_search: 50,
            threads: 0,
            max_dead_share: 0.5,
            check_s: 0,
        },
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 1 << 20,
        commit_batch: 8,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(60) },
    }
}

/// A map whose model gives three dimensions.
pub fn map() -> Map {
    Map {
        uid: Uuid::now_v7(),
        name: "m".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "old".into(),
        model_digest: Digest::of(b"old"),
        precision: Precision::Full,
        dim: 3,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    }
}

/// An image without a pose.
pub fn image(id: &str, bytes: &[u8]) -> Image {
    Image {
        id: id.parse().unwrap(),
        digest: Digest::of(bytes),
        pose: None,
        captured_at: None,
        tags: Vec::new(),
        media_type: MediaType::Jpeg,
        width: 1,
        height: 1,
        created_at: Timestamp::now(),
    }
}
