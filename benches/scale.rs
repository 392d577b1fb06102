//! Search in the two stores on the same clustered unit vectors of 384 dimensions: the graph of the embedded
//! store in this process, and pgvector through the store in PostgreSQL.
//!
//! `WHEREABOUTS_TEST_SHARED_BUFFERS=4GB tests/postgres.sh target/postgres-venv cargo bench --bench scale --
//! 10000 100000`. Each number is a size of map; with `embedded` or `postgres` before them only that store is
//! measured. Latencies are of one caller and of eight; recall is of the ten nearest, against exact search.

mod vectors;

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use jiff::Timestamp;
use rayon::prelude::*;
use sqlx::postgres::{PgConnection, PgPoolCopyExt};
use sqlx::{AssertSqlSafe, Connection, PgPool};
use uuid::Uuid;
use whereabouts_core::{
    CoordinateFrame, Description, Descriptor, DescriptorKind, Digest, Image, Job, JobState, Map,
    MediaType, Precision, RefinerKind, Scene, Usage,
};
use whereabouts_index::{IndexSettings, MapIndex, SearchMode};
use whereabouts_store::postgres::{PostgresSettings, PostgresStore, migrate};
use whereabouts_store::{
    BlobStore, DescriptionBounds, JobRecord, JobStore, MapStore, Objects, Query, Step,
};

use self::vectors::{DIM, Rows, clustered, recall};

const QUERIES: usize = 500;
const K: usize = 10;
const CALLERS: usize = 8;
const JOBS: usize = 50;
const STEPS: usize = 10;
const INDEX: IndexSettings = IndexSettings {
    exact_up_to: 1000,
    m: 16,
    ef_construction: 200,
    ef_search: 96,
    threads: 0,
    max_dead_share: 1.0,
    check_s: 0,
};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let sizes: Vec<usize> = arguments.iter().filter_map(|argument| argument.parse().ok()).collect();
    let sizes = if sizes.is_empty() { vec![10_000, 100_000] } else { sizes };
    let only = |store: &str| arguments.iter().any(|argument| argument == store);
    let url = std::env::var("WHEREABOUTS_TEST_DATABASE_URL")
        .context("run it through tests/postgres.sh")?;
    for size in sizes {
        let (rows, queries) = (clustered(size, 7), clustered(QUERIES, 11));
        let index = MapIndex::new(INDEX);
        (0..size).for_each(|slot| index.add(slot));
        let truth: Vec<_> = (0..QUERIES)
            .into_par_iter()
            .map(|query| find(&index, &rows, queries.row(query), SearchMode::Exact))
            .collect();
        if !only("postgres") {
            in_process(&index, &rows, &queries, &truth)?;
        }
        if !only("embedded") {
            in_postgres(&url, &rows, &queries, size, &truth).await?;
        }
    }
    Ok(())
}

fn find(index: &MapIndex, rows: &Rows, query: &[f32], mode: SearchMode) -> Vec<usize> {
    index.search(rows, query, K, mode).iter().map(|found| found.slot).collect()
}

/// Builds the graph of the embedded store and prints its speed and recall.
fn in_process(
    index: &MapIndex,
    rows: &Rows,
    queries: &Rows,
    truth: &[Vec<usize>],
) -> anyhow::Result<()> {
    let size = index.len();
    let find = |query: usize, mode| find(index, rows, queries.row(query), mode);
    let exact = median((0..30).map(|query| timed(|| find(query, SearchMode::Exact))).collect());
    let threads = rayon::ThreadPoolBuilder::default().build()?;
    let start = Instant::now();
    let mut said = 0;
    while index.has_work() {
        index.catch_up(rows, 1000, &threads);
        let tenths = 10 * index.graphed() / size;
        if tenths > said {
            said = tenths;
            eprintln!("{said}0 % in the graph after {:.0} s", start.elapsed().as_secs_f64());
        }
    }
    let built = start.elapsed();
    let mut found = Vec::new();
    let took = (0..QUERIES).map(|query| timed(|| found.push(find(query, SearchMode::Fast))));
    let took: Vec<Duration> = took.collect();
    let (p50, p99) = (median(took.clone()), percentile(took, 0.99));
    println!(
        "{size} in this process: built in {:.1} s, recall@10 {:.4}, p50 {:.2} ms, p99 {:.2} ms; exact \
         p50 {:.2} ms; sealed graph {:.0} MB",
        built.as_secs_f64(),
        recall(&found, truth),
        ms(p50),
        ms(p99),
        ms(exact),
        index.sealed_bytes() as f64 / 1e6
    );
    Ok(())
}

async fn in_postgres(
    url: &str,
    rows: &Rows,
    queries: &Rows,
    size: usize,
    truth: &[Vec<usize>],
) -> anyhow::Result<()> {
    let database = format!("scale_{}", Uuid::now_v7().simple());
    let mut server = PgConnection::connect(url).await?;
    sqlx::query(AssertSqlSafe(format!("CREATE DATABASE {database}"))).execute(&mut server).await?;
    let (base, _) = url.rsplit_once('/').context("the address names no database")?;
    let url = format!("{base}/{database}");
    let pictures = tempfile::tempdir()?;
    let settings = PostgresSettings {
        url: url.clone(),
        max_connections: 16,
        timeout: Duration::from_secs(60),
        lifetime: Duration::from_secs(120),
        pin: Duration::from_secs(60),
        index: INDEX,
        index_memory_mib: 3000,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(60) },
    };
    migrate(&settings).await?;
    let objects = Objects::folder(pictures.path(), Duration::from_secs(5))?;
    let store = Arc::new(PostgresStore::open(settings, objects, Uuid::now_v7()).await?);
    let (map, _) = store.put_map(map()?).await?;
    let pool = PgPool::connect(&url).await?;
    let start = Instant::now();
    fill(&pool, &map, rows, size).await?;
    let filled = start.elapsed();
    let exact = search(&store, &map, queries, 30, SearchMode::Exact).await?;
    let count = "INSERT INTO image_counts VALUES ($1, 0, $2, $2)";
    sqlx::query(count).bind(map.uid).bind(size as i64).execute(&pool).await?;
    let start = Instant::now();
    while !store.index_state(&map).await?.graph {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let built = start.elapsed();
    let table = format!("descriptors_{}_0", map.uid.simple());
    let graph = format!("graph_{}_0", map.uid.simple());
    let bytes = "SELECT pg_relation_size($1::regclass)::double precision / 1e6";
    let table_mb: f64 = sqlx::query_scalar(bytes).bind(table).fetch_one(&pool).await?;
    let graph_mb: f64 = sqlx::query_scalar(bytes).bind(graph).fetch_one(&pool).await?;
    search(&store, &map, queries, QUERIES, SearchMode::Fast).await?;
    let (took, found): (Vec<_>, Vec<_>) =
        search(&store, &map, queries, QUERIES, SearchMode::Fast).await?.into_iter().unzip();
    let start = Instant::now();
    let callers = (0..CALLERS).map(|_| search(&store, &map, queries, QUERIES, SearchMode::Fast));
    futures_util::future::try_join_all(callers).await?;
    let many = (CALLERS * QUERIES) as f64 / start.elapsed().as_secs_f64();
    println!(
        "{size} in PostgreSQL: filled in {:.1} s (table {table_mb:.0} MB), index built in {:.1} s \
         ({graph_mb:.0} MB), recall@10 {:.4}, p50 {:.2} ms, p99 {:.2} ms, {many:.0} searches/s by {CALLERS} \
         callers; exact p50 {:.2} ms",
        filled.as_secs_f64(),
        built.as_secs_f64(),
        recall(&found, truth),
        ms(median(took.clone())),
        ms(percentile(took, 0.99)),
        ms(median(exact.into_iter().map(|(took, _)| took).collect()))
    );
    let start = Instant::now();
    let jobs = futures_util::future::try_join_all((0..CALLERS).map(|_| jobs(&store, &map))).await?;
    let jobs: usize = jobs.into_iter().sum();
    println!(
        "{size} in PostgreSQL: {:.0} jobs/s through the queue by {CALLERS} workers, {STEPS} steps each",
        jobs as f64 / start.elapsed().as_secs_f64()
    );
    pool.close().await;
    drop(store);
    let drop = format!("DROP DATABASE {database} WITH (FORCE)");
    sqlx::query(AssertSqlSafe(drop)).execute(&mut server).await?;
    Ok(())
}

/// Inserts images and descriptors directly: the store would use one transaction for each.
async fn fill(pool: &PgPool, map: &Map, rows: &Rows, size: usize) -> anyhow::Result<()> {
    let image = Image {
        id: "x".parse()?,
        digest: Digest::of(b"x"),
        pose: None,
        captured_at: None,
        tags: Vec::new(),
        media_type: MediaType::Jpeg,
        width: 1,
        height: 1,
        created_at: Timestamp::now(),
    };
    sqlx::query(
        "INSERT INTO images (map_uid, id, slot, digest, record) OVERRIDING SYSTEM VALUE
         SELECT $1, slot::text, slot, '\\x00', $3::json FROM generate_series(0, $2 - 1) slot",
    )
    .bind(map.uid)
    .bind(size as i64)
    .bind(serde_json::to_string(&image)?)
    .execute(pool)
    .await?;
    let table = format!("descriptors_{}_0", map.uid.simple());
    let mut copy =
        pool.copy_in_raw(&format!("COPY {table} FROM STDIN WITH (FORMAT binary)")).await?;
    let mut bytes = b"PGCOPY\n\xff\r\n\0\0\0\0\0\0\0\0\0".to_vec();
    for slot in 0..size {
        bytes.extend(2_i16.to_be_bytes());
        bytes.extend(8_i32.to_be_bytes());
        bytes.extend((slot as i64).to_be_bytes());
        bytes.extend((4 + 4 * DIM as i32).to_be_bytes());
        bytes.extend((DIM as i16).to_be_bytes());
        bytes.extend([0; 2]);
        bytes.extend(rows.row(slot).iter().flat_map(|number| number.to_be_bytes()));
        if bytes.len() > 1 << 20 {
            copy.send(std::mem::take(&mut bytes)).await?;
        }
    }
    bytes.extend((-1_i16).to_be_bytes());
    copy.send(bytes).await?;
    copy.finish().await?;
    for tidy in [format!("VACUUM ANALYZE {table}"), "VACUUM ANALYZE images".to_owned()] {
        sqlx::raw_sql(AssertSqlSafe(tidy)).execute(pool).await?;
    }
    Ok(())
}

/// Submits jobs, claims as many, records their steps and finishes them; returns how many.
async fn jobs(store: &PostgresStore, map: &Map) -> anyhow::Result<usize> {
    let now = Timestamp::now();
    let digest = Digest::of(b"frame");
    let _pin = store.put_blob(digest, "frame".into()).await?;
    for _ in 0..JOBS {
        let id = Uuid::now_v7();
        let query = Query {
            id,
            digest,
            media_type: MediaType::Jpeg,
            created_at: now,
            descriptor: None,
            uninformative: None,
        };
        let record = JobRecord {
            job: Job::queued(map.name.clone(), id, RefinerKind::Mllm, now),
            map_uid: map.uid,
            revision: map.revision,
            query,
            candidates: Vec::new(),
            claims: 0,
            traceparent: None,
        };
        store.submit(record, usize::MAX / 2).await?;
        let until = now + jiff::SignedDuration::from_mins(5);
        // Another worker may have claimed the only job that this one saw, and submitted its own a moment
        // later.
        let taken = loop {
            match store.claim(now, until).await? {
                Some(taken) => break taken,
                None => tokio::task::yield_now().await,
            }
        };
        for step in 0..STEPS {
            let description = Description {
                image_id: format!("image-{step}").parse()?,
                text: "What agrees and what differs, in so many words. ".repeat(20),
                cached: false,
                stands_in: None,
                took_ms: None,
                usage: Usage::default(),
            };
            let step = Step { usage: Usage::default(), description: Some(description) };
            store.progress(taken.claim(), step).await?;
        }
        let job = Job { state: JobState::Succeeded, finished_at: Some(now), ..taken.job.clone() };
        store.finish(taken.claim(), job).await?;
    }
    Ok(JOBS)
}

/// Searches one after another; returns the time and the result of each.
async fn search(
    store: &PostgresStore,
    map: &Map,
    queries: &Rows,
    count: usize,
    mode: SearchMode,
) -> anyhow::Result<Vec<(Duration, Vec<usize>)>> {
    let mut all = Vec::new();
    for query in 0..count {
        let descriptor = Descriptor::normalised(queries.row(query).to_vec())?;
        let start = Instant::now();
        let found = store.search(map, descriptor, K, mode).await?;
        let took = start.elapsed();
        let slots = found.iter().map(|found| found.image_id.as_str().parse());
        all.push((took, slots.collect::<Result<_, _>>()?));
    }
    Ok(all)
}

fn map() -> anyhow::Result<Map> {
    Ok(Map {
        uid: Uuid::now_v7(),
        name: "m".parse()?,
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::Gem,
        frame: CoordinateFrame::Wgs84,
        model: "made up".into(),
        model_digest: Digest::of(b"made up"),
        precision: Precision::Full,
        dim: DIM,
        revision: 0,
        description: None,
        created_at: Timestamp::now(),
    })
}

fn timed<T>(work: impl FnOnce() -> T) -> Duration {
    let start = Instant::now();
    std::hint::black_box(work());
    start.elapsed()
}

fn median(took: Vec<Duration>) -> Duration {
    percentile(took, 0.5)
}

fn percentile(mut took: Vec<Duration>, share: f64) -> Duration {
    took.sort();
    took[((took.len() - 1) as f64 * share) as usize]
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
