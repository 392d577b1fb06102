//! A map of a few plain pictures in memory, and a refiner that calls the mock server.

use std::collections::HashMap;
use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use image::{Rgb, RgbImage};
use jiff::Timestamp;
use jiff::civil::Date;
use parking_lot::Mutex;
use uuid::Uuid;

use super::super::settings::tests::defaults;
use super::*;
use crate::{FrameTexts, QueryFrame};
use whereabouts_core::{CacheLevels, CachedDescription, DescribedFrame, Secret, SimilarFrame};
use whereabouts_core::{
    Calibration, CalibrationSettings, Candidate, CoordinateFrame, DayUsage, Descriptor,
    DescriptorKind, Digest, Image, ImageId, Map, MapName, MediaType, Precision, Priority,
    Recording, StandIn, Usage,
};
use whereabouts_index::SearchMode;
use whereabouts_store::{
    Added, BlobPin, DescriptionFilter, HardNegatives, IndexState, LocatedImage, Step, StoreError,
};
use whereabouts_telemetry::metrics::registry;
use whereabouts_testkit::mock_mllm::{MockMllm, Script};
use whereabouts_vision::decode::encode_jpeg;

/// The API key that the mock demands.
pub const KEY: &str = "sk-test-5c1f";

/// A map with the images `image-0`, `image-1`, …
#[derive(Clone)]
pub struct Shelf {
    pub map: Map,
    /// Their bytes; the last picture is the frame.
    pictures: Arc<Vec<Bytes>>,
    /// The calibration of the map, if there is one.
    pub calibration: Arc<Mutex<Option<Arc<Calibration>>>>,
}

/// The mock server, and a refiner that calls it.
pub struct Bench {
    pub mock: MockMllm,
    pub shelf: Shelf,
    pub cache: Arc<MemoryCache>,
    pub fallback: Option<Arc<dyn Refiner>>,
    pub settings: MllmSettings,
    pub refiner: MllmRefiner,
}

impl Bench {
    pub async fn new(script: Script) -> Self {
        Self::with(script, |_| {}).await
    }

    pub async fn with(script: Script, change: impl FnOnce(&mut MllmSettings)) -> Self {
        let mock = MockMllm::start(Script { key: Some(KEY.into()), ..script }).await;
        let mut settings = MllmSettings {
            base_url: mock.url(),
            api_key: Secret::new(KEY),
            backoff_ms: 1,
            ..defaults()
        };
        change(&mut settings);
        let (shelf, cache) = (Shelf::new(), Arc::new(MemoryCache::default()));
        let refiner = refiner(&shelf, &cache, None, &settings);
        Self { mock, shelf, cache, fallback: None, settings, refiner }
    }

    /// Replaces the refiner, as a restart with other settings does. The cache is kept.
    pub fn rebuild(&mut self, change: impl FnOnce(&mut MllmSettings)) {
        change(&mut self.settings);
        self.refiner = refiner(&self.shelf, &self.cache, self.fallback.clone(), &self.settings);
    }

    pub fn input(&self, candidates: usize) -> RefineInput {
        self.shelf.input(candidates)
    }

    /// Another instance, over the same cache.
    pub fn model(&self) -> MllmRefiner {
        refiner(&self.shelf, &self.cache, None, &self.settings)
    }

    pub async fn refine(&self, candidates: usize) -> Result<Refinement, RefineError> {
        self.refiner.refine(&self.input(candidates), &Steps::default()).await
    }
}

fn refiner(
    shelf: &Shelf,
    cache: &Arc<MemoryCache>,
    fallback: Option<Arc<dyn Refiner>>,
    settings: &MllmSettings,
) -> MllmRefiner {
    let parts = MllmParts {
        maps: Arc::new(shelf.clone()),
        blobs: Arc::new(shelf.clone()),
        cache: cache.clone(),
        usage: cache.clone(),
        shared: None,
        metrics: Arc::new(RefineMetrics::register(&mut registry(), Arc::default())),
        limits: ImageLimits { max_pixels: 1_000_000 },
        fallback,
    };
    MllmRefiner::new(parts, settings.clone()).unwrap()
}

/// Encodes a number as a picture: twice as many white columns, which survive compression.
fn picture(number: u32) -> Bytes {
    let column = |x| Rgb([if x < 2 * number { 255 } else { 0 }; 3]);
    encode_jpeg(&RgbImage::from_fn(64, 48, |x, _| column(x))).unwrap().into()
}

impl Shelf {
    pub fn new() -> Self {
        let map = Map {
            uid: Uuid::from_u128(1),
            name: "m".parse().unwrap(),
            scene: Scene::Outdoor,
            descriptor: DescriptorKind::GEM,
            frame: CoordinateFrame::Metric,
            model: "none".into(),
            model_digest: Digest::of(b"none"),
            precision: Precision::Full,
            dim: 1,
            revision: 0,
            refiner: None,
            vocabulary: None,
            keeps_shipped: false,
            description: None,
            created_at: Timestamp::UNIX_EPOCH,
        };
        let pictures = Arc::new((0..24).map(picture).collect());
        Self { map, pictures, calibration: Arc::default() }
    }

    /// Returns the digest of a picture.
    pub fn digest(&self, number: usize) -> Digest {
        Digest::of(&self.pictures[number])
    }

    fn input(&self, candidates: usize) -> RefineInput {
        let candidate = |index: usize| Candidate {
            rank: index + 1,
            image_id: format!("image-{index}").parse().unwrap(),
            similarity: 0.9,
            pose: None,
            order: None,
        };
        RefineInput {
            id: Uuid::now_v7(),
            map: self.map.clone(),
            refiner: None,
            frame: QueryFrame {
                query_id: Uuid::now_v7(),
                digest: self.digest(self.pictures.len() - 1),
                descriptor: None,
                uninformative: false,
                texts: FrameTexts::default(),
            },
            candidates: (0..candidates).map(candidate).collect(),
            priority: Priority::Normal,
            attempts_left: 0,
            spent: Usage::default(),
            fresh_since: None,
        }
    }
}

fn unused<T>() -> Result<T, StoreError> {
    Err(StoreError::Failed("the refiner should not call this".into()))
}

#[async_trait]
impl MapStore for Shelf {
    async fn map(&self, _: &MapName) -> Result<Option<Map>, StoreError> {
        Ok(Some(self.map.clone()))
    }

    async fn image(&self, _: &Map, id: &ImageId) -> Result<Option<Image>, StoreError> {
        let number = id.as_str().strip_prefix("image-").and_then(|number| number.parse().ok());
        Ok(number.map(|number: usize| Image {
            id: id.clone(),
            digest: Digest::of(&self.pictures[number]),
            media_type: MediaType::Jpeg,
            width: 64,
            height: 48,
            pose: None,
            captured_at: None,
            tags: vec![],
            created_at: Timestamp::UNIX_EPOCH,
        }))
    }

    async fn put_map(&self, _: Map) -> Result<(Map, bool), StoreError> {
        unused()
    }

    async fn maps(&self) -> Result<Vec<Map>, StoreError> {
        unused()
    }

    async fn delete_map(&self, _: &MapName) -> Result<bool, StoreError> {
        unused()
    }

    async fn index_state(&self, _: &Map) -> Result<IndexState, StoreError> {
        unused()
    }

    async fn add_recorded(
        &self,
        _: &Map,
        _: Image,
        _: Descriptor,
        _: Option<Recording>,
    ) -> Result<Added, StoreError> {
        unused()
    }

    async fn replace_image(&self, _: &Map, _: &Image, _: Image) -> Result<bool, StoreError> {
        unused()
    }

    async fn images(
        &self,
        _: &Map,
        _: Option<&ImageId>,
        _: usize,
    ) -> Result<Vec<Image>, StoreError> {
        unused()
    }

    async fn positions(&self, _: &Map) -> Result<Vec<LocatedImage>, StoreError> {
        unused()
    }

    async fn descriptors(
        &self,
        _: &Map,
        _: Vec<usize>,
    ) -> Result<Vec<Option<Descriptor>>, StoreError> {
        unused()
    }

    async fn similarities(
        &self,
        _: &Map,
        _: Vec<f32>,
        _: Vec<usize>,
    ) -> Result<Vec<Option<f32>>, StoreError> {
        unused()
    }

    async fn delete_image(&self, _: &Map, _: &ImageId) -> Result<bool, StoreError> {
        unused()
    }

    async fn search(
        &self,
        _: &Map,
        _: Descriptor,
        _: usize,
        _: SearchMode,
    ) -> Result<Vec<Candidate>, StoreError> {
        unused()
    }

    async fn slots(&self, _: &Map, _: &[ImageId]) -> Result<Vec<Option<usize>>, StoreError> {
        unused()
    }

    async fn hard_negatives(
        &self,
        _: &Map,
        _: CalibrationSettings,
        _: usize,
    ) -> Result<Vec<HardNegatives>, StoreError> {
        unused()
    }

    async fn calibration(&self, _: &Map) -> Result<Option<Arc<Calibration>>, StoreError> {
        Ok(self.calibration.lock().clone())
    }

    async fn put_calibration(&self, _: &Map, _: Calibration) -> Result<(), StoreError> {
        unused()
    }
}

#[async_trait]
impl BlobStore for Shelf {
    async fn put_blob(&self, _: Digest, _: Bytes) -> Result<BlobPin, StoreError> {
        unused()
    }

    async fn blob(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        Ok(self.pictures.iter().find(|bytes| Digest::of(bytes) == *digest).cloned())
    }
}

/// Records the steps of a refinement.
#[derive(Default)]
pub struct Steps(pub Mutex<Vec<Step>>);

#[async_trait]
impl Progress for Steps {
    async fn step(&self, step: Step) {
        self.0.lock().push(step);
    }
}

/// Keeps descriptions, frames and accounts in memory.
#[derive(Default)]
pub struct MemoryCache {
    descriptions: Mutex<HashMap<Digest, CachedDescription>>,
    frames: Mutex<Vec<DescribedFrame>>,
    pub spent: Mutex<Vec<DayUsage>>,
}

impl MemoryCache {
    /// Forgets the descriptions.
    pub fn forget(&self) {
        self.descriptions.lock().clear();
    }
}

#[async_trait]
impl UsageStore for MemoryCache {
    async fn add_usage(&self, spent: DayUsage) -> Result<(), StoreError> {
        self.spent.lock().push(spent);
        Ok(())
    }

    async fn usage(&self, _: Date) -> Result<Vec<DayUsage>, StoreError> {
        unused()
    }
}

#[async_trait]
impl DescriptionCache for MemoryCache {
    async fn description(&self, key: &Digest) -> Result<Option<CachedDescription>, StoreError> {
        Ok(self.descriptions.lock().get(key).cloned())
    }

    async fn keep_description(
        &self,
        key: Digest,
        value: CachedDescription,
    ) -> Result<(), StoreError> {
        self.descriptions.lock().insert(key, value);
        Ok(())
    }

    async fn descriptions(
        &self,
        _: &DescriptionFilter,
        _: Option<&Digest>,
        _: usize,
    ) -> Result<Vec<(Digest, CachedDescription)>, StoreError> {
        unused()
    }

    async fn remove_descriptions(&self, _: &[Digest]) -> Result<usize, StoreError> {
        unused()
    }

    async fn similar_frames(
        &self,
        _: Uuid,
        to: &Descriptor,
        at_least: f32,
    ) -> Result<Vec<SimilarFrame>, StoreError> {
        let frames = self.frames.lock();
        let similar = frames.iter().map(|frame| SimilarFrame {
            digest: frame.digest,
            stand_in: StandIn {
                query_id: frame.query_id,
                similarity: frame.descriptor.similarity(to),
            },
        });
        Ok(similar.filter(|frame| frame.stand_in.similarity >= at_least).collect())
    }

    async fn keep_frame(&self, _: Uuid, frame: DescribedFrame, _: usize) -> Result<(), StoreError> {
        self.frames.lock().push(frame);
        Ok(())
    }

    fn levels(&self) -> CacheLevels {
        CacheLevels::default()
    }
}
