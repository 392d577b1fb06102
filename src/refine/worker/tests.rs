//! The worker over an embedded store, with a refiner that does as it is told.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use tempfile::TempDir;
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;
use uuid::Uuid;
use whereabouts_core::{
    Candidate, CoordinateFrame, DescriptorKind, Digest, Map, MediaType, Precision, Ranking,
    RefinerKind, Scene, Usage,
};
use whereabouts_index::IndexSettings;
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::{BlobStore, DescriptionBounds, Query};
use whereabouts_telemetry::metrics::registry;

use super::*;

/// Refines jobs when it gets permits to.
struct Told {
    /// Whether jobs wait for a network.
    waits: bool,
    has_room: watch::Sender<bool>,
    /// One for each job that may end.
    permits: Semaphore,
    in_progress: AtomicUsize,
    most: AtomicUsize,
    /// This job never ends.
    hangs: Option<Uuid>,
}

impl Told {
    fn new(waits: bool) -> Self {
        Self {
            waits,
            has_room: watch::Sender::new(true),
            permits: Semaphore::new(0),
            in_progress: AtomicUsize::new(0),
            most: AtomicUsize::new(0),
            hangs: None,
        }
    }
}

#[async_trait]
impl Refiner for Told {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Mllm
    }

    async fn room(&self) {
        self.has_room.subscribe().wait_for(|has_room| *has_room).await.unwrap();
    }

    async fn refine(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        struct Ends<'a>(&'a AtomicUsize);
        impl Drop for Ends<'_> {
            fn drop(&mut self) {
                self.0.fetch_sub(1, Ordering::SeqCst);
            }
        }
        let others = self.in_progress.fetch_add(1, Ordering::SeqCst);
        let _ends = Ends(&self.in_progress);
        self.most.fetch_max(others + 1, Ordering::SeqCst);
        if self.waits {
            progress.waiting(true);
        }
        if self.hangs == Some(input.id) {
            std::future::pending::<()>().await;
        }
        self.permits.acquire().await.unwrap().forget();
        progress.waiting(false);
        Ok(Refinement {
            descriptions: vec![],
            agreement: None,
            verdicts: vec![],
            ranking: Ranking::new(&input.candidates, &[0]).unwrap(),
            ordered_by: None,
            evidence: None,
            certainty: None,
            reasoning: None,
            reasoning_took_ms: None,
            usage: Usage::default(),
            degraded: None,
        })
    }
}

/// A worker at work.
struct Fixture {
    store: Arc<EmbeddedStore>,
    map: Map,
    refiner: Arc<Told>,
    shutdown: CancellationToken,
    running: Option<JoinHandle<()>>,
    _folder: TempDir,
}

impl Fixture {
    async fn new(workers: usize, in_progress: usize, refiner: Told) -> Self {
        Self::with(workers, in_progress, refiner, 0).await.0
    }

    /// A worker that starts when so many jobs are queued.
    async fn with(
        workers: usize,
        in_progress: usize,
        mut refiner: Told,
        jobs: usize,
    ) -> (Self, Vec<Uuid>) {
        let folder = tempfile::tempdir().unwrap();
        let store = Arc::new(open(folder.path()));
        let (map, _) = store.put_map(map()).await.unwrap();
        let mut queued = Vec::new();
        for _ in 0..jobs {
            queued.push(submit(&store, &map).await);
        }
        if refiner.hangs.is_some() {
            refiner.hangs = queued.first().copied();
        }
        let refiner = Arc::new(refiner);
        let worker = Worker {
            jobs: store.clone(),
            maps: store.clone(),
            refiner: refiner.clone(),
            reader: None,
            metrics: Arc::new(RefineMetrics::register(&mut registry(), Arc::default())),
            service_time: JobServiceTime::default(),
            settings: settings(workers, in_progress),
            known_confidence: 0.5,
        };
        let shutdown = CancellationToken::new();
        let running = Some(tokio::spawn(worker.run(shutdown.clone())));
        let fixture = Self { store, map, refiner, shutdown, running, _folder: folder };
        (fixture, queued)
    }

    async fn submit(&self) -> Uuid {
        submit(&self.store, &self.map).await
    }

    async fn state(&self, job: Uuid) -> JobState {
        self.store.job(job).await.unwrap().unwrap().job.state
    }

    /// Waits until jobs have these states.
    async fn until(&self, jobs: &[Uuid], wanted: &[JobState]) {
        let mut changes = self.store.changes();
        loop {
            let mut states = Vec::new();
            for job in jobs {
                states.push(self.state(*job).await);
            }
            if states == wanted {
                return;
            }
            changes.recv().await.unwrap();
        }
    }

    async fn stop(&mut self) {
        self.shutdown.cancel();
        self.running.take().unwrap().await.unwrap();
    }
}

fn open(dir: &Path) -> EmbeddedStore {
    EmbeddedStore::open(&EmbeddedSettings {
        dir: dir.to_owned(),
        index: IndexSettings {
            exact_up_to: 1000,
            m: 8,
            ef_construction: 50,
            ef_search: 50,
            max_dead_share: 1.0,
            threads: 0,
            check_s: 0,
        },
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 1 << 20,
        commit_batch: 64,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age: Duration::from_secs(3600) },
    })
    .unwrap()
}

fn map() -> Map {
    Map {
        uid: Uuid::from_u128(1),
        name: "m".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Metric,
        model: "none".into(),
        model_digest: Digest::of(b"none"),
        precision: Precision::Full,
        dim: 4,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::now(),
    }
}

async fn submit(store: &EmbeddedStore, map: &Map) -> Uuid {
    let now = Timestamp::now();
    let frame = Uuid::now_v7();
    let query = Query {
        id: frame,
        digest: Digest::of(frame.as_bytes()),
        media_type: MediaType::Jpeg,
        created_at: now,
        descriptor: None,
        uninformative: None,
    };
    let _pin = store.put_blob(query.digest, frame.as_bytes().to_vec().into()).await.unwrap();
    let record = JobRecord {
        job: Job::queued(map.name.clone(), query.id, RefinerKind::Mllm, now),
        map_uid: map.uid,
        revision: 0,
        query,
        candidates: vec![Candidate {
            rank: 1,
            image_id: "image-0".parse().unwrap(),
            similarity: 0.9,
            pose: None,
            order: None,
        }],
        claims: 0,
        traceparent: None,
    };
    let id = record.job.id;
    store.submit(record, usize::MAX).await.unwrap();
    id
}

fn settings(workers: usize, in_progress: usize) -> JobSettings {
    JobSettings {
        queue: 100,
        shed_at: 0.5,
        workers,
        in_progress,
        lease: Duration::from_secs(60),
        timeout: Duration::from_secs(50),
        attempts: 3,
        retry_pause: Duration::from_secs(2),
        max_wait: Duration::from_secs(60),
        keep: None,
        keep_count: None,
        sweep: Duration::from_secs(60),
        sweep_batch: 1,
    }
}

use JobState::{Queued, Running, Succeeded};

#[tokio::test]
async fn jobs_that_wait_for_a_network_leave_their_turn_to_others() {
    let (fixture, jobs) = Fixture::with(1, 100, Told::new(true), 6).await;
    fixture.until(&jobs, &[Running; 6]).await;
    fixture.refiner.permits.add_permits(6);
    fixture.until(&jobs, &[Succeeded; 6]).await;
}

#[tokio::test]
async fn as_many_jobs_use_this_machine_as_there_are_workers_the_oldest_first() {
    let (fixture, jobs) = Fixture::with(2, 100, Told::new(false), 4).await;
    fixture.until(&jobs, &[Running, Running, Queued, Queued]).await;
    // A job is running a moment before it is refined.
    while fixture.refiner.in_progress.load(Ordering::SeqCst) < 2 {
        tokio::task::yield_now().await;
    }
    fixture.refiner.permits.add_permits(4);
    fixture.until(&jobs, &[Succeeded; 4]).await;
    assert_eq!(fixture.refiner.most.load(Ordering::SeqCst), 2);
}

#[tokio::test]
async fn no_more_jobs_are_in_progress_than_the_settings_allow() {
    let (fixture, jobs) = Fixture::with(1, 3, Told::new(true), 5).await;
    fixture.until(&jobs, &[Running, Running, Running, Queued, Queued]).await;
    fixture.refiner.permits.add_permits(1);
    let ended = |states: &[JobState]| states.iter().filter(|state| **state == Succeeded).count();
    let mut changes = fixture.store.changes();
    loop {
        // The youngest first: if it runs, an older one has ended.
        let mut states = Vec::new();
        for job in jobs.iter().rev() {
            states.push(fixture.state(*job).await);
        }
        let running = states.iter().filter(|state| **state == Running).count();
        assert!(running <= 3, "{states:?}");
        if ended(&states) == 1 && running == 3 {
            break;
        }
        changes.recv().await.unwrap();
    }
    while fixture.refiner.in_progress.load(Ordering::SeqCst) < 3 {
        tokio::task::yield_now().await;
    }
    assert_eq!(fixture.refiner.most.load(Ordering::SeqCst), 3);
}

#[tokio::test]
async fn no_job_is_claimed_while_the_refiner_has_no_room() {
    let refiner = Told::new(true);
    refiner.has_room.send_replace(false);
    let fixture = Fixture::new(1, 100, refiner).await;
    let jobs = [fixture.submit().await, fixture.submit().await];
    // A worker that claims does so at the latest when a change wakes it; here, two did.
    for _ in 0..100 {
        tokio::task::yield_now().await;
        assert_eq!(fixture.state(jobs[0]).await, Queued);
    }
    fixture.refiner.has_room.send_replace(true);
    fixture.until(&jobs, &[Running; 2]).await;
}

#[tokio::test]
async fn one_job_that_hangs_delays_itself_only() {
    let refiner = Told { hangs: Some(Uuid::nil()), ..Told::new(true) };
    let (fixture, jobs) = Fixture::with(1, 100, refiner, 20).await;
    fixture.refiner.permits.add_permits(20);
    let mut wanted = [Succeeded; 20];
    wanted[0] = Running;
    fixture.until(&jobs, &wanted).await;
}

#[tokio::test]
async fn at_shutdown_all_jobs_in_progress_go_back_to_the_queue() {
    let (mut fixture, jobs) = Fixture::with(1, 100, Told::new(true), 5).await;
    fixture.until(&jobs, &[Running; 5]).await;
    fixture.stop().await;
    for job in &jobs {
        let job = fixture.store.job(*job).await.unwrap().unwrap().job;
        assert_eq!((job.state, job.attempts), (Queued, 0), "{:?}", job.error);
    }
    assert_eq!(fixture.refiner.in_progress.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn a_cancelled_job_ends_and_the_others_go_on() {
    let (fixture, jobs) = Fixture::with(1, 100, Told::new(true), 3).await;
    fixture.until(&jobs, &[Running; 3]).await;
    while fixture.refiner.in_progress.load(Ordering::SeqCst) < 3 {
        tokio::task::yield_now().await;
    }
    fixture.store.cancel(jobs[1]).await.unwrap();
    while fixture.refiner.in_progress.load(Ordering::SeqCst) > 2 {
        tokio::task::yield_now().await;
    }
    fixture.refiner.permits.add_permits(2);
    fixture.until(&jobs, &[Succeeded, JobState::Cancelled, Succeeded]).await;
}
