//! A server's tracks without the server: a store with one map, its calibration, and the filter.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use async_trait::async_trait;
use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt, future, stream};
use jiff::{SignedDuration, Timestamp};
use tempfile::TempDir;
use uuid::Uuid;
use whereabouts_core::{
    Calibration, CoordinateFrame, Descriptor, DescriptorKind, Digest, Image, Map, MediaType,
    MetricPose, Pose, Precision, Scene,
};
use whereabouts_index::{IndexSettings, SearchMode};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_service::{Calibrator, FrameEvidence, Odometry, Principal, TrackStep, Tracks};
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::postgres::{PostgresSettings, PostgresStore, migrate};
use whereabouts_store::{
    BlobStore, DescriptionBounds, MapStore, Objects, StoreError, TrackHead, TrackKey, TrackRead,
    TrackState, TrackStore,
};

use super::LARGE;

/// What is answered to a frame.
pub struct Located {
    /// The number of the image in the map.
    pub image: Option<usize>,
    pub probability: f64,
    pub known: bool,
    /// The probability that the robot is off the map.
    pub off_map: f64,
}

/// A store with one map, and the tracks in it.
pub struct Robots {
    store: Arc<EmbeddedStore>,
    tracks: Tracks,
    map: Map,
    calibration: Arc<Calibration>,
    known_confidence: f64,
    _folder: TempDir,
}

/// Where tracks are stored before each answer.
#[derive(Debug, Clone, Copy)]
pub enum Shared {
    File,
    Postgres,
}

/// Tracks in files, as if another server shared them.
struct SharedFiles(Arc<EmbeddedStore>);

#[async_trait]
impl TrackStore for SharedFiles {
    fn shares_tracks(&self) -> bool {
        true
    }

    async fn track(
        &self,
        key: &TrackKey,
        known: Option<u64>,
        idle: Duration,
    ) -> Result<TrackRead, StoreError> {
        self.0.track(key, known, idle).await
    }

    async fn put_track(
        &self,
        key: &TrackKey,
        before: Option<u64>,
        next: TrackState,
        idle: Duration,
    ) -> Result<Option<u64>, StoreError> {
        self.0.put_track(key, before, next, idle).await
    }

    async fn tracks(
        &self,
        map: Uuid,
        id: Option<&str>,
        limit: usize,
        idle: Duration,
    ) -> Result<Vec<TrackHead>, StoreError> {
        self.0.tracks(map, id, limit, idle).await
    }

    async fn prune_tracks(&self, idle: Duration, most: usize) -> Result<usize, StoreError> {
        self.0.prune_tracks(idle, most).await
    }
}

/// The database of WHEREABOUTS_TEST_DATABASE_URL, if there is one.
async fn database(folder: &Path) -> anyhow::Result<Option<PostgresStore>> {
    let Ok(url) = std::env::var("WHEREABOUTS_TEST_DATABASE_URL") else { return Ok(None) };
    let settings = PostgresSettings {
        url,
        max_connections: 4,
        timeout: Duration::from_secs(60),
        lifetime: Duration::from_secs(60),
        pin: Duration::from_secs(3600),
        index: settings(folder).index,
        index_memory_mib: 64,
        descriptions: settings(folder).descriptions,
    };
    migrate(&settings).await?;
    let objects = Objects::folder(&folder.join("objects"), Duration::from_secs(60))?;
    Ok(Some(PostgresStore::open(settings, objects, Uuid::now_v7()).await?))
}

impl Robots {
    pub async fn new(images: &[(Descriptor, [f64; 2])]) -> anyhow::Result<Self> {
        let robots = Self::storing(images, None).await?;
        robots.context("tracks in memory need no database")
    }

    /// The same with tracks that are stored before each answer; `None` if there is no database for them.
    pub async fn storing(
        images: &[(Descriptor, [f64; 2])],
        shared: Option<Shared>,
    ) -> anyhow::Result<Option<Self>> {
        let folder = TempDir::new()?;
        let config = Config::load(None, &Overrides::default())?;
        let store = Arc::new(EmbeddedStore::open(&settings(folder.path()))?);
        let stored: Arc<dyn TrackStore> = match shared {
            None => store.clone(),
            Some(Shared::File) => Arc::new(SharedFiles(store.clone())),
            Some(Shared::Postgres) => match database(folder.path()).await? {
                Some(database) => Arc::new(database),
                None => return Ok(None),
            },
        };
        let tracks = Tracks::new(store.clone(), stored, config.confidence.place_m, config.track);
        let map = Map {
            uid: Uuid::now_v7(),
            name: "drive".parse()?,
            scene: Scene::Outdoor,
            descriptor: DescriptorKind::GEM,
            frame: CoordinateFrame::Metric,
            model: "xfeat".into(),
            model_digest: Digest::of(b"model"),
            precision: Precision::Full,
            dim: images.first().context("no images")?.0.as_slice().len(),
            revision: 0,
            refiner: None,
            vocabulary: None,
            keeps_shipped: false,
            description: None,
            created_at: Timestamp::now(),
        };
        let (map, _) = store.put_map(map).await?;
        let digest = Digest::of(b"picture");
        let _pin = store.put_blob(digest, Bytes::from_static(b"picture")).await?;
        let adding = images.iter().enumerate().map(|(number, (descriptor, [x, y]))| {
            let image = Image {
                id: id(number).parse().unwrap_or_else(|_| unreachable!("the id is valid")),
                digest,
                pose: Some(metric(*x, *y)),
                captured_at: None,
                tags: Vec::new(),
                media_type: MediaType::Jpeg,
                width: 1,
                height: 1,
                created_at: Timestamp::now(),
            };
            store.add_image(&map, image, descriptor.clone())
        });
        // In order, and many in one commit.
        stream::iter(adding).buffered(2048).try_for_each(|_| future::ready(Ok(()))).await?;
        let calibrator = Calibrator {
            store: store.clone(),
            refiner: None,
            settings: config.confidence.calibration(0),
            model_candidates: 0,
            reindexer: None,
        };
        let calibration = match images.len() < LARGE {
            true => {
                calibrator.calibrate(&map, None).await?;
                store.calibration(&map).await?.unwrap_or_default()
            }
            false => Arc::default(),
        };
        let known_confidence = config.localize.known_confidence;
        Ok(Some(Self { store, tracks, map, calibration, known_confidence, _folder: folder }))
    }

    /// One step of a track. Returns what the filter answers, and the milliseconds that it took.
    pub async fn step(
        &self,
        step: TrackStep,
        frame: &Descriptor,
        mode: SearchMode,
    ) -> anyhow::Result<(Located, f64)> {
        let k = self.tracks.candidates();
        let candidates = self.store.search(&self.map, frame.clone(), k, mode).await?;
        let evidence = FrameEvidence::new(&candidates, &self.calibration);
        let start = Instant::now();
        let (estimate, _) = self.tracks.follow(&self.map, step, frame, Some(evidence)).await?;
        let elapsed = start.elapsed().as_secs_f64() * 1e3;
        let image = estimate.image_id.and_then(|id| number(id.as_str()));
        let located = Located {
            image,
            probability: estimate.probability,
            known: estimate.known,
            off_map: estimate.off_map,
        };
        Ok((located, elapsed))
    }

    /// What the frame alone is answered: its most similar image, with its calibrated confidence.
    pub async fn alone(&self, frame: &Descriptor) -> anyhow::Result<Located> {
        let candidates = self.store.search(&self.map, frame.clone(), 10, SearchMode::Exact).await?;
        let confidence = FrameEvidence::new(&candidates, &self.calibration).confidence;
        let confidence = f64::from(confidence.unwrap_or_default());
        Ok(Located {
            image: candidates.first().and_then(|first| number(first.image_id.as_str())),
            probability: confidence,
            known: confidence >= self.known_confidence - 1e-6,
            off_map: 0.0,
        })
    }
}

fn number(id: &str) -> Option<usize> {
    id.trim_start_matches("image-").parse().ok()
}

fn settings(dir: &Path) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            // Graphs have nothing to do with tracks.
            exact_up_to: 2 * LARGE,
            m: 16,
            ef_construction: 200,
            ef_search: 96,
            threads: 0,
            max_dead_share: 0.3,
            check_s: 0,
        },
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 64 << 20,
        commit_batch: 4096,
        descriptions: DescriptionBounds {
            max_bytes: 1 << 28,
            max_age: Duration::from_secs(86_400),
        },
    }
}

fn id(number: usize) -> String {
    format!("image-{number:06}")
}

fn metric(x: f64, y: f64) -> Pose {
    Pose::Metric(MetricPose { x, y, z: None, qx: None, qy: None, qz: None, qw: None })
}

pub fn step_at(seconds: f64, odometry: Option<f64>) -> anyhow::Result<TrackStep> {
    let at = Timestamp::UNIX_EPOCH + SignedDuration::try_from_secs_f64(seconds)?;
    let odometry = odometry.map(Odometry::distance).transpose()?;
    Ok(TrackStep::new(&Principal::Anonymous, "robot".into(), Some(at), odometry)?)
}
