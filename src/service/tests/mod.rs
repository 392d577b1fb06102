//! Tests of the use cases over an embedded store in a temporary folder. No model is installed and no
//! server listens.

mod calibration;
mod idempotency;
mod images;
mod jobs;
mod limits;
mod localize;
mod maps;
mod reading;
mod retention;
mod sharing;
mod submit;
mod track;
mod transfer;
mod usage;
mod ways;
mod webhooks;

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use jiff::Timestamp;
use parking_lot::Mutex;
use tempfile::TempDir;
use uuid::Uuid;

use crate::rejections::Rejections;
use crate::*;
use whereabouts_core::{
    Candidate, CoordinateFrame, Descriptor, DescriptorKind, Digest, Evidence, Image, Job, Map,
    MediaType, MetricPose, Pose, Precision, RefinerKind, Scene,
};
use whereabouts_index::IndexSettings;
use whereabouts_reading::Reader;
use whereabouts_refine::{
    NegativeEvidence, PaidMeasurement, PaidNegatives, Progress, RefineError, RefineInput,
    Refinement,
};
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::{
    BlobStore, DescriptionBounds, HardNegatives, JobRecord, JobStore, MapStore, Query,
};
use whereabouts_telemetry::metrics::registry;
use whereabouts_vision::{
    AdmissionSettings, Assets, ExtractorSettings, ImageLimits, LoadedSettings,
};

/// Dimensions of the descriptors.
const DIM: usize = 4;

/// The name of a model that is not installed.
const MODEL: &str = "not-installed";

/// The use cases over a store of their own.
struct Fixture {
    service: Service,
    store: Arc<EmbeddedStore>,
    refiner: Arc<ScriptedRefiner>,
    _folder: TempDir,
}

impl Fixture {
    async fn new() -> Self {
        Self::with(0, |_| {}).await
    }

    /// Use cases with other settings, over a disk on which `min_free_bytes` must stay free.
    async fn with(min_free_bytes: u64, change: impl FnOnce(&mut ServiceSettings)) -> Self {
        Self::reading(None, min_free_bytes, change).await
    }

    /// Use cases with a reader of text.
    async fn reading(
        reader: Option<Arc<dyn Reader>>,
        min_free_bytes: u64,
        change: impl FnOnce(&mut ServiceSettings),
    ) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let store = Arc::new(open(&folder.path().join("store"), min_free_bytes));
        let refiner = Arc::new(ScriptedRefiner::default());
        let limits = ImageLimits { max_pixels: 1 << 20 };
        let models = LoadedSettings {
            max_loaded: 1,
            choice_dir: folder.path().join("remember"),
            extractor: ExtractorSettings::plain(MODEL, 1, limits),
        };
        let admission = AdmissionSettings {
            permits: 1,
            queue: 2,
            max_wait: Duration::from_secs(60),
            max_retry_after: Duration::from_secs(60),
        };
        let mut registry = registry();
        let rejections = Arc::new(Rejections::register(&mut registry));
        let metrics = Arc::new(ServiceMetrics::register(&mut registry, rejections));
        let admission = Admission::new(admission);
        let reading =
            Reading::new(reader, store.clone(), admission.clone(), limits, Arc::clone(&metrics));
        let parts = ServiceParts {
            store: store.clone(),
            process: Uuid::now_v7(),
            keys: Keys::load(store.clone()).await.unwrap(),
            models: LoadedModels::new(Assets::locate(Some(folder.path())), models),
            admission,
            reading: Arc::new(reading.unwrap()),
            pool: CpuPool::new("test", 1, 1).unwrap(),
            refiner: Some(refiner.clone()),
            dense: Arc::new(DenseCache::new(1 << 20)),
            job_service_time: JobServiceTime::default(),
            metrics,
        };
        let mut settings = settings();
        change(&mut settings);
        Self { service: Service::new(parts, settings), store, refiner, _folder: folder }
    }

    /// A metric map with `poses.len()` images, `image-0` and so on, whose descriptors all differ.
    async fn map(&self, name: &str, poses: &[Option<f64>]) -> Map {
        let (map, _) = self.store.put_map(map(name)).await.unwrap();
        for (number, x) in poses.iter().enumerate() {
            let (bytes, image) = image(number, *x);
            let _pin = self.store.put_blob(image.digest, bytes.into()).await.unwrap();
            self.store.add_image(&map, image, descriptor(number)).await.unwrap();
        }
        map
    }

    /// A queued job.
    async fn job(&self, map: &str) -> Job {
        let record = record(map);
        let frame = record.job.id.as_bytes().to_vec();
        let _pin = self.store.put_blob(record.query.digest, frame.into()).await.unwrap();
        let job = record.job.clone();
        self.store.submit(record, usize::MAX).await.unwrap();
        job
    }
}

fn open(dir: &Path, min_free_bytes: u64) -> EmbeddedStore {
    let index = IndexSettings {
        exact_up_to: 1000,
        m: 8,
        ef_construction: 50,
        ef_search: 50,
        max_dead_share: 1.0,
        threads: 0,
        check_s: 0,
    };
    let descriptions = DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(3600) };
    EmbeddedStore::open(&EmbeddedSettings {
        dir: dir.to_owned(),
        index,
        index_threads: 1,
        min_free_bytes,
        db_cache_bytes: 1 << 20,
        commit_batch: 64,
        descriptions,
    })
    .unwrap()
}

/// Jobs that are kept until they are removed by hand.
fn job_settings() -> JobSettings {
    JobSettings {
        queue: 3,
        shed_at: 0.4,
        workers: 1,
        in_progress: 8,
        lease: Duration::from_secs(60),
        timeout: Duration::from_secs(30),
        attempts: 3,
        retry_pause: Duration::from_secs(2),
        max_wait: Duration::from_secs(60),
        keep: None,
        keep_count: None,
        sweep: Duration::from_secs(60),
        sweep_batch: 1,
    }
}

pub(crate) fn settings() -> ServiceSettings {
    ServiceSettings {
        localize: LocalizeSettings { k: 5, max_k: 20, known_confidence: 0.5 },
        track: TrackSettings {
            max: 2,
            idle_s: 600,
            max_speed_m_s: 10.0,
            odometry_error: 0.1,
            outliers: 0.2,
            turn: 0.005,
            jump: 0.005,
            leave: 0.005,
            enter: 0.02,
            sharpness: 1.0,
            candidates: 10,
            states: 64,
            history: 50,
            stored: 10,
            state_bytes: 1 << 18,
            verdicts: true,
            known_probability: 0.5,
        },
        confidence: ConfidenceSettings {
            images: 100,
            refined: 100,
            place_images: 0,
            place_m: 5.0,
            model_calls: 0,
        },
        vocabulary: VocabularySettings { own: true, min_images: 10, max_images: 20, loaded: 2 },
        jobs: job_settings(),
        refiners: AllowedRefiners {
            default: Some(RefinerKind::Local),
            allowed: vec![(RefinerKind::Local, 5)],
        },
        compared: 5,
        recall_check: None,
        usage_days: 30,
        idempotency: IdempotencySettings { keep: Duration::from_secs(3600), most: 100 },
        bulk: BulkSettings {
            in_flight: 1,
            patience_s: 1,
            max_images: 10,
            memory_bytes: 1 << 20,
            meta_bytes: 1 << 16,
        },
        webhooks: crate::webhooks::defaults(),
    }
}

pub(crate) fn map(name: &str) -> Map {
    Map {
        uid: Uuid::now_v7(),
        name: name.parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Metric,
        model: MODEL.into(),
        model_digest: Digest::of(b"model"),
        precision: Precision::Full,
        dim: DIM,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    }
}

/// An image that begins like a JPEG file, `x` metres along a road if it has a pose.
pub(crate) fn image(number: usize, x: Option<f64>) -> (Vec<u8>, Image) {
    let bytes = [&[0xFF, 0xD8, 0xFF][..], &number.to_le_bytes()].concat();
    let image = Image {
        id: image_id(number),
        digest: Digest::of(&bytes),
        pose: x.map(metric),
        captured_at: None,
        tags: Vec::new(),
        media_type: MediaType::Jpeg,
        width: 1,
        height: 1,
        created_at: Timestamp::now(),
    };
    (bytes, image)
}

fn image_id(number: usize) -> whereabouts_core::ImageId {
    format!("image-{number}").parse().unwrap()
}

fn metric(x: f64) -> Pose {
    Pose::Metric(MetricPose { x, y: 0.0, z: None, qx: None, qy: None, qz: None, qw: None })
}

/// A descriptor that is the less like that of number 0 the higher its number.
pub(crate) fn descriptor(number: usize) -> Descriptor {
    Descriptor::normalised(vec![1.0, number as f32 / 10.0, 0.0, 0.0]).unwrap()
}

/// Candidates with these numbers and similarities, in this order.
fn candidates(similar: &[(usize, f32)]) -> Vec<Candidate> {
    let ranked = similar.iter().zip(1..);
    ranked
        .map(|(&(number, similarity), rank)| Candidate {
            rank,
            image_id: image_id(number),
            similarity,
            pose: None,
            order: None,
        })
        .collect()
}

fn record(map: &str) -> JobRecord {
    let now = Timestamp::now();
    let query_id = Uuid::now_v7();
    let job = Job::queued(map.parse().unwrap(), query_id, RefinerKind::Local, now);
    let query = Query {
        id: query_id,
        digest: Digest::of(job.id.as_bytes()),
        media_type: MediaType::Jpeg,
        created_at: now,
        descriptor: None,
        uninformative: None,
    };
    JobRecord {
        job,
        map_uid: Uuid::now_v7(),
        revision: 0,
        query,
        candidates: candidates(&[(0, 0.9)]),
        claims: 0,
        traceparent: None,
    }
}

/// A refiner with scripted measurements, which refines nothing.
#[derive(Default)]
struct ScriptedRefiner {
    /// Errors of the next measurements; each further one finds an agreement of 0.5.
    measurements: Mutex<VecDeque<RefineError>>,
    /// Images that were measured, failed attempts included.
    measured: Mutex<Vec<whereabouts_core::ImageId>>,
    /// How often the model was asked.
    verdicts: Mutex<usize>,
}

#[async_trait]
impl Refiner for ScriptedRefiner {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Local
    }

    async fn refine(&self, _: &RefineInput, _: &dyn Progress) -> Result<Refinement, RefineError> {
        Err(RefineError::Permanent("this refiner refines nothing".into()))
    }

    fn negative_evidence(&self) -> Option<&dyn NegativeEvidence> {
        Some(self)
    }

    fn paid_negatives(&self) -> Option<&dyn PaidNegatives> {
        Some(self)
    }
}

#[async_trait]
impl NegativeEvidence for ScriptedRefiner {
    async fn best_negative(
        &self,
        _: &Map,
        negatives: &HardNegatives,
    ) -> Result<Vec<Evidence>, RefineError> {
        self.measured.lock().push(negatives.image_id.clone());
        match self.measurements.lock().pop_front() {
            Some(error) => Err(error),
            None => Ok(vec![Evidence::Agreement(0.5), Evidence::Verdict(0.5)]),
        }
    }
}

#[async_trait]
impl PaidNegatives for ScriptedRefiner {
    fn cost(&self, candidates: usize) -> PaidMeasurement {
        PaidMeasurement { calls: candidates + 1, tokens: 1000, money: 0.0 }
    }

    async fn verdict(&self, _: &Map, _: &HardNegatives) -> Result<Option<Evidence>, RefineError> {
        *self.verdicts.lock() += 1;
        Ok(Some(Evidence::Verdict(-2.0)))
    }
}
