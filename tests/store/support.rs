//! Stores under test, each in a folder or a database of its own, and test data.

use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use jiff::{SignedDuration, Timestamp};
use sqlx::postgres::PgConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions};
use tempfile::TempDir;
use uuid::Uuid;
use whereabouts_core::{
    CoordinateFrame, Descriptor, DescriptorKind, Digest, Image, Job, Map, MediaType, Precision,
    RefinerKind, Scene,
};
use whereabouts_index::IndexSettings;
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::postgres::{PostgresSettings, PostgresStore, migrate};
use whereabouts_store::{
    Added, DescriptionBounds, Draft, JobRecord, JobRetention, ObjectSettings, Objects, Query, Store,
};

pub use whereabouts_testkit::wait::{eventually, until};

/// Turns each of these functions into a test of both stores.
macro_rules! contract {
    ($($promise:ident),+ $(,)?) => {
        mod embedded {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $promise() {
                super::$promise(&crate::support::Fixture::embedded()).await;
            })+
        }
        mod postgres {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $promise() {
                super::$promise(&crate::support::Fixture::postgres().await).await;
            })+
        }
    };
}

/// Turns each of these functions into a test of PostgreSQL with its bytes in an S3-compatible store.
macro_rules! contract_over_s3 {
    ($($promise:ident),+ $(,)?) => {
        mod s3 {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $promise() {
                super::$promise(&crate::support::Fixture::postgres_and_s3().await).await;
            })+
        }
    };
}

/// Settings of a store that tests vary.
#[derive(Debug, Clone, Copy)]
pub struct Tuning {
    /// Maps with at most this many images have no graph.
    pub exact_up_to: usize,
    /// How long unreferenced new bytes are kept, in stores that keep them for a time.
    pub pin: Duration,
    /// A process without a heartbeat for this long is considered dead.
    pub lifetime: Duration,
    /// Timeout of a call.
    pub timeout: Duration,
    /// Bounds of the cache of descriptions.
    pub descriptions: DescriptionBounds,
}

impl Default for Tuning {
    fn default() -> Self {
        Self {
            exact_up_to: 10_000,
            pin: Duration::ZERO,
            lifetime: SHORT_LIFE,
            timeout: Duration::from_secs(20),
            descriptions: DescriptionBounds {
                max_bytes: 1 << 20,
                max_age: Duration::from_secs(3600),
            },
        }
    }
}

/// A lifetime after which tests can wait for a process to be considered dead.
const SHORT_LIFE: Duration = Duration::from_millis(300);

/// The storage of a store, which outlives the store.
pub struct Fixture(Kind);

enum Kind {
    Embedded(TempDir),
    Postgres(Box<Database>),
}

impl Fixture {
    pub fn embedded() -> Self {
        Self(Kind::Embedded(tempfile::tempdir().unwrap()))
    }

    pub async fn postgres() -> Self {
        Self(Kind::Postgres(Box::new(Database::migrated(Pictures::Folder).await)))
    }

    pub async fn postgres_and_s3() -> Self {
        Self(Kind::Postgres(Box::new(Database::migrated(Pictures::S3).await)))
    }

    /// Opens the store. To open it again, as after a restart, drop it first.
    pub async fn open(&self) -> Arc<dyn Store> {
        self.open_with(Tuning::default()).await
    }

    pub async fn open_with(&self, tuning: Tuning) -> Arc<dyn Store> {
        match &self.0 {
            Kind::Embedded(dir) => {
                let settings = embedded_settings(dir.path(), tuning);
                // The threads of the dropped store may take a moment to end.
                let open = async || EmbeddedStore::open(&settings).ok();
                Arc::new(eventually(open).await)
            }
            Kind::Postgres(database) => Arc::new(database.open(tuning).await),
        }
    }
}

fn index(tuning: Tuning) -> IndexSettings {
    IndexSettings {
        exact_up_to: tuning.exact_up_to,
        m: 16,
        ef_construction: 100,
        ef_search: 64,
        threads: 0,
        max_dead_share: 0.3,
        check_s: 0,
    }
}

fn embedded_settings(dir: &Path, tuning: Tuning) -> EmbeddedSettings {
    EmbeddedSettings {
        dir: dir.to_owned(),
        index: index(tuning),
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 1 << 20,
        commit_batch: 64,
        descriptions: tuning.descriptions,
    }
}

/// Where a PostgreSQL store keeps its bytes.
#[derive(Clone, Copy)]
pub enum Pictures {
    Folder,
    S3,
}

/// A database of its own in the test server, which is removed when this is dropped; and a place for bytes.
pub struct Database {
    server: PgConnectOptions,
    name: String,
    objects: Objects,
    _dir: TempDir,
}

impl Database {
    /// An empty one.
    pub async fn empty(pictures: Pictures) -> Self {
        let server = PgConnectOptions::from_str(&server()).unwrap();
        let name = format!("test_{}", Uuid::now_v7().simple());
        administer(&server, &format!("CREATE DATABASE {name}")).await;
        let dir = tempfile::tempdir().unwrap();
        let objects = match pictures {
            Pictures::Folder => Objects::folder(dir.path(), Duration::from_secs(20)).unwrap(),
            Pictures::S3 => s3(&name, &s3_server(), Duration::from_secs(20)),
        };
        Self { server, name, objects, _dir: dir }
    }

    /// One with the schema.
    pub async fn migrated(pictures: Pictures) -> Self {
        let database = Self::empty(pictures).await;
        migrate(&database.settings(Tuning::default())).await.unwrap();
        database
    }

    pub fn objects(&self) -> Objects {
        self.objects.clone()
    }

    pub fn options(&self) -> PgConnectOptions {
        self.server.clone().database(&self.name)
    }

    pub fn settings(&self, tuning: Tuning) -> PostgresSettings {
        PostgresSettings {
            url: self.options().to_url_lossy().to_string(),
            max_connections: 16,
            timeout: tuning.timeout,
            lifetime: tuning.lifetime,
            pin: tuning.pin,
            index: index(tuning),
            index_memory_mib: 64,
            descriptions: tuning.descriptions,
        }
    }

    /// Opens the store as another process would.
    pub async fn open(&self, tuning: Tuning) -> PostgresStore {
        PostgresStore::open(self.settings(tuning), self.objects(), Uuid::now_v7()).await.unwrap()
    }

    /// Runs a statement on a connection that is not the store's.
    pub async fn run(&self, sql: &str) {
        administer(&self.options(), sql).await;
    }

    /// Reads one number on a connection that is not the store's.
    pub async fn number(&self, sql: &str) -> f64 {
        let mut connection = self.options().connect().await.unwrap();
        let sql = format!("SELECT ({sql})::float8");
        sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(&mut connection).await.unwrap()
    }
}

impl Drop for Database {
    fn drop(&mut self) {
        let (server, name) = (self.server.clone(), self.name.clone());
        // The runtime of the test cannot be blocked.
        let dropping = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let sql = format!("DROP DATABASE {name} WITH (FORCE)");
            runtime.unwrap().block_on(administer(&server, &sql));
        });
        let _ = dropping.join();
    }
}

async fn administer(at: &PgConnectOptions, sql: &str) {
    let mut connection = at.connect().await.unwrap();
    sqlx::raw_sql(AssertSqlSafe(sql.to_owned())).execute(&mut connection).await.unwrap();
}

const HOW_TO_RUN: &str = "run `make test`, or `tests/postgres.sh target/postgres-venv tests/s3.sh \
     target/s3-venv cargo test --release --test store`";

fn server() -> String {
    std::env::var("WHEREABOUTS_TEST_DATABASE_URL").unwrap_or_else(|_| {
        panic!("WHEREABOUTS_TEST_DATABASE_URL names no PostgreSQL; {HOW_TO_RUN}")
    })
}

fn s3_server() -> String {
    std::env::var("WHEREABOUTS_TEST_S3").unwrap_or_else(|_| {
        panic!("WHEREABOUTS_TEST_S3 names no server that speaks S3; {HOW_TO_RUN}")
    })
}

/// A prefix in the test bucket.
pub fn s3(prefix: &str, endpoint: &str, timeout: Duration) -> Objects {
    let url = format!("s3://whereabouts-test/{prefix}");
    let (endpoint, region) = (endpoint.to_owned(), "us-east-1".to_owned());
    Objects::open(&ObjectSettings { url, endpoint, region, allow_http: true, timeout }).unwrap()
}

/// A map whose descriptors have this many dimensions.
pub fn map(name: &str, dim: usize) -> Map {
    Map {
        uid: Uuid::now_v7(),
        name: name.parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "old".into(),
        model_digest: Digest::of(b"old"),
        precision: Precision::Full,
        dim,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    }
}

/// The map with another model.
pub fn next(map: &Map, dim: usize) -> Map {
    Map {
        model: "new".into(),
        model_digest: Digest::of(b"new"),
        dim,
        revision: map.revision + 1,
        ..map.clone()
    }
}

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

/// A descriptor that differs from picture to picture.
pub fn descriptor(image: &Image, dim: usize) -> Descriptor {
    let seed = image.digest.as_bytes().first_chunk().unwrap();
    Random(u64::from_le_bytes(*seed) | 1).descriptor(dim)
}

/// Adds an image with its bytes, and with the descriptor of its picture.
pub async fn add(store: &dyn Store, map: &Map, id: &str, bytes: &[u8]) -> Image {
    let image = image(id, bytes);
    let descriptor = descriptor(&image, map.dim);
    let _pin = store.put_blob(image.digest, Bytes::copy_from_slice(bytes)).await.unwrap();
    let added = store.add_image(map, image.clone(), descriptor).await.unwrap();
    assert_eq!(added, Added::Created(image.clone()));
    image
}

/// Writes all missing descriptors of a draft; returns how many were missing.
pub async fn fill(draft: &mut dyn Draft, dim: usize) -> usize {
    let mut written = 0;
    loop {
        let missing = draft.missing(3).await.unwrap();
        if missing.is_empty() {
            return written;
        }
        for image in missing {
            draft.write(&image, descriptor(&image, dim)).await.unwrap();
            written += 1;
        }
    }
}

/// Submits a job of the map, with the bytes of its frame.
pub async fn submit(store: &dyn Store, map: &str, frame: &[u8]) -> Uuid {
    let record = record(map, frame);
    let id = record.job.id;
    submit_record(store, record, frame).await;
    id
}

pub async fn submit_record(store: &dyn Store, record: JobRecord, frame: &[u8]) {
    let bytes = Bytes::copy_from_slice(frame);
    let _pin = store.put_blob(record.query.digest, bytes).await.unwrap();
    store.submit(record, 1000).await.unwrap();
}

pub fn record(map: &str, frame: &[u8]) -> JobRecord {
    let (now, id) = (Timestamp::now(), Uuid::now_v7());
    let digest = Digest::of(frame);
    let query = Query {
        id,
        digest,
        media_type: MediaType::Jpeg,
        created_at: now,
        descriptor: None,
        uninformative: None,
    };
    let job = Job::queued(map.parse().unwrap(), id, RefinerKind::Local, now);
    JobRecord {
        job,
        map_uid: Uuid::nil(),
        revision: 0,
        query,
        candidates: vec![],
        claims: 0,
        traceparent: None,
    }
}

/// Claims a job with a lease of a minute.
pub async fn claim(store: &dyn Store) -> Option<JobRecord> {
    let now = Timestamp::now();
    store.claim(now, now + SignedDuration::from_secs(60)).await.unwrap()
}

/// Whether the bytes are still there after a sweep.
pub async fn is_kept(store: &dyn Store, bytes: &[u8]) -> bool {
    let all = JobRetention { since: None, most: None, settled: Timestamp::now() };
    store.remove_ended(all, 64).await.unwrap();
    store.blob(&Digest::of(bytes)).await.unwrap().is_some()
}

/// Texts that are hard to store.
pub fn odd_texts() -> Vec<String> {
    vec![
        String::new(),
        "\0 begins with nothing, and ends with it \0".into(),
        r#"'; DROP TABLE maps; -- " \ \u0000 {"a": [1]}"#.into(),
        "🤖 東京 e\u{301} \u{feff}\u{202e}\u{ffff}".into(),
        "\r\n\t\u{1}\u{7f}".into(),
        "long \u{1F5FA} ".repeat(10_000),
    ]
}

/// Numbers that look random and are the same in every run.
pub struct Random(pub u64);

impl Random {
    /// 0 to below 1.
    pub fn unit(&mut self) -> f32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 40) as f32 / (1_u64 << 24) as f32
    }

    pub fn descriptor(&mut self, dim: usize) -> Descriptor {
        self.near(&vec![0.0; dim], 1.0)
    }

    /// A direction near that of `centre`.
    pub fn near(&mut self, centre: &[f32], by: f32) -> Descriptor {
        let numbers = centre.iter().map(|x| x + by * (self.unit() - 0.5)).collect();
        Descriptor::normalised(numbers).unwrap()
    }
}
