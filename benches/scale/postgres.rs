//! The store in PostgreSQL: search by pgvector, and jobs through the queue.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use jiff::Timestamp;
use sqlx::postgres::{PgConnection, PgPoolCopyExt};
use sqlx::{AssertSqlSafe, Connection, PgPool};
use uuid::Uuid;
use whereabouts_core::{
    CoordinateFrame, Description, Descriptor, DescriptorKind, Digest, Image, Job, JobState, Map,
    MediaType, Precision, RefinerKind, Scene, Usage,
};
use whereabouts_index::{IndexSettings, SearchMode};
use whereabouts_store::postgres::{PostgresSettings, PostgresStore, migrate};
use whereabouts_store::{
    BlobStore, DescriptionBounds, JobRecord, JobStore, MapStore, Objects, Query, Step,
};

use super::vectors::{Rows, Set};
use super::{K, median, ms, percentile};

const CALLERS: usize = 8;
const JOBS: usize = 50;
const STEPS: usize = 10;

/// Fills a database of its own, builds the index, and prints its speed, its recall and the images that it loses.
pub async fn measure(url: &str, set: &Set, index: IndexSettings) -> anyhow::Result<()> {
    let (rows, queries, size) = (&set.rows, &set.queries, set.rows.len());
    let name = &set.name;
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
        index,
        index_memory_mib: 3000,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(60) },
    };
    migrate(&settings).await?;
    let objects = Objects::folder(pictures.path(), Duration::from_secs(5))?;
    let store = Arc::new(PostgresStore::open(settings, objects, Uuid::now_v7()).await?);
    let (map, _) = store.put_map(map(rows.dim)?).await?;
    let pool = PgPool::connect(&url).await?;
    let start = Instant::now();
    fill(&pool, &map, rows, size).await?;
    let filled = start.elapsed();
    let exact = search(&store, &map, queries, 30.min(queries.len()), SearchMode::Exact).await?;
    let count = "INSERT INTO image_counts VALUES ($1, 0, $2, $2)";
    sqlx::query(count).bind(map.uid).bind(size as i64).execute(&pool).await?;
    let start = Instant::now();
    while !store.index_state(&map).await?.graph {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    let built = start.elapsed();
    let table = format!("descriptors_{}_0", map.uid.simple());
    let graph = format!("firsts_{}_0", map.uid.simple());
    let bytes = "SELECT pg_relation_size($1::regclass)::double precision / 1e6";
    let table_mb: f64 = sqlx::query_scalar(bytes).bind(table).fetch_one(&pool).await?;
    let graph_mb: f64 = sqlx::query_scalar(bytes).bind(graph).fetch_one(&pool).await?;
    search(&store, &map, queries, queries.len(), SearchMode::Fast).await?;
    let (took, found): (Vec<_>, Vec<_>) =
        search(&store, &map, queries, queries.len(), SearchMode::Fast).await?.into_iter().unzip();
    let all: Vec<_> = (0..size).collect();
    let recall = set.recall(&found, &set.truth(all.iter().copied()));
    let sample = set.sample(all);
    let themselves = Rows {
        dim: rows.dim,
        numbers: sample.iter().flat_map(|&slot| rows.row(slot).to_vec()).collect(),
    };
    let found = search(&store, &map, &themselves, themselves.len(), SearchMode::Fast).await?;
    let lost =
        sample.iter().zip(&found).filter(|(slot, (_, found))| !set.is_twin(**slot, found)).count();
    let start = Instant::now();
    let callers =
        (0..CALLERS).map(|_| search(&store, &map, queries, queries.len(), SearchMode::Fast));
    futures_util::future::try_join_all(callers).await?;
    let many = (CALLERS * queries.len()) as f64 / start.elapsed().as_secs_f64();
    println!(
        "{name} in PostgreSQL: filled in {:.1} s (table {table_mb:.0} MB), index built in {:.1} s \
         ({graph_mb:.0} MB), recall@10 {recall:.4}, lost {lost} of {}, p50 {:.2} ms, p99 {:.2} ms, {many:.0} searches/s by {CALLERS} \
         callers; exact p50 {:.2} ms",
        filled.as_secs_f64(),
        built.as_secs_f64(),
        sample.len(),
        ms(median(took.clone())),
        ms(percentile(took, 0.99)),
        ms(median(exact.into_iter().map(|(took, _)| took).collect()))
    );
    let start = Instant::now();
    let jobs = futures_util::future::try_join_all((0..CALLERS).map(|_| jobs(&store, &map))).await?;
    let jobs: usize = jobs.into_iter().sum();
    println!(
        "{name} in PostgreSQL: {:.0} jobs/s through the queue by {CALLERS} workers, {STEPS} steps each",
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
        bytes.extend((4 + 4 * rows.dim as i32).to_be_bytes());
        bytes.extend((rows.dim as i16).to_be_bytes());
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

fn map(dim: usize) -> anyhow::Result<Map> {
    Ok(Map {
        uid: Uuid::now_v7(),
        name: "m".parse()?,
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "made up".into(),
        model_digest: Digest::of(b"made up"),
        precision: Precision::Full,
        dim,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    })
}
