//! The only place where everything is wired: build, serve, drain.

mod store;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use jiff::Timestamp;
use tokio::net::TcpListener;
use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::Metrics;
use crate::config::Config;
use crate::gate::{Connections, Gate, GateSettings};
use crate::http::{About, AppState};
use crate::router::{router, worker_router};
use whereabouts_core::CalibrationSettings;
use whereabouts_refine::{
    AttemptPolicy, DenseCache, JobServiceTime, Refiner, RefinerContext, Worker, WorkerSettings,
};
use whereabouts_service::{
    Dispatcher, IdempotencySettings, Janitor, Keys, Limits, RecallCheck, Reindexes,
    RetentionSettings, Service, ServiceSettings, Tracks, Webhooks,
};
use whereabouts_store::{JobStore, TokenBuckets};
use whereabouts_telemetry::LogIssues;
use whereabouts_vision::{Admission, Assets, CpuPool, ExtractorSettings};
use whereabouts_vision::{LoadedModels, LoadedSettings, WhyModel};

#[cfg(feature = "postgres")]
pub use self::store::postgres_settings;
pub use self::store::{OpenStore, open_store};

/// What a process does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// It takes requests, and refines unless `jobs.workers` is 0.
    Serve,
    /// It refines, and answers nobody but those who look after it.
    Worker,
}

/// Works on `listener` until `shutdown`, then drains. `on_ready` runs once `/readyz` answers 200; `troubles`
/// are those of the log.
pub async fn run(
    role: Role,
    config: Config,
    troubles: Arc<LogIssues>,
    listener: TcpListener,
    shutdown: CancellationToken,
    on_ready: impl FnOnce(SocketAddr) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let address = listener.local_addr().context("the listener has no address")?;
    let metrics = Arc::new(Metrics::new());
    let gate = Gate::new(gate_settings(&config), Arc::clone(&metrics));
    let state = AppState { gate, about: Arc::new(about(&config, troubles)?) };
    let connections = Connections {
        settings: config.server.connections(),
        router: match role {
            Role::Serve => router(state.clone()),
            Role::Worker => worker_router(state.clone()),
        },
        metrics: Arc::clone(&metrics),
        tls: config.server.tls()?.map(Arc::new),
    };
    let encrypted = connections.tls.is_some();
    let server = tokio::spawn(connections.serve(listener, shutdown.clone()));
    let (drain_timeout, retention) = (config.server.drain_timeout(), retention(&config));
    let counted = Arc::clone(&metrics.service);
    let building = tokio::task::spawn_blocking(move || build(&config, metrics));
    let Parts { service, workers, pools, .. } = building.await.context("the start broke off")??;
    let janitor = Janitor {
        store: Arc::clone(&service.retention),
        answers: Arc::clone(&service.answers),
        metrics: Arc::clone(&counted),
        settings: retention,
    };
    let Webhooks { store, settings } = &service.webhooks;
    let dispatcher = Dispatcher::new(Arc::clone(store), counted, settings.clone());
    let service = Arc::new(service);
    state.gate.readiness().open(Arc::clone(&service));
    let mut running = JoinSet::new();
    if role == Role::Serve {
        let until = shutdown.clone();
        running.spawn(async move { janitor.run(until).await });
        running.spawn(dispatcher.run(shutdown.clone()));
        let until = shutdown.clone();
        running.spawn(async move { service.keep_calibrated(until).await });
    }
    for worker in workers {
        let shutdown = shutdown.clone();
        running.spawn(async move { worker.run(shutdown).await });
    }
    on_ready(address)?;
    tracing::info!(%address, tls = encrypted, "ready");

    shutdown.cancelled().await;
    tracing::info!("draining");
    state.gate.readiness().drain();
    let drained = async {
        let served = server.await;
        while running.join_next().await.is_some() {}
        served
    };
    match tokio::time::timeout(drain_timeout, drained).await {
        Ok(served) => served.context("the server broke off")?,
        Err(_) => tracing::warn!(
            seconds = drain_timeout.as_secs(),
            "requests were still in progress when the drain timed out"
        ),
    }
    let idle = move || pools.iter().for_each(|pool| pool.wait_until_idle(drain_timeout));
    tokio::task::spawn_blocking(idle).await.context("the end broke off")?;
    tracing::info!("stopped");
    Ok(())
}

fn about(config: &Config, troubles: Arc<LogIssues>) -> anyhow::Result<About> {
    Ok(About {
        started_at: Timestamp::now(),
        settings: toml::to_string(config)?,
        pictures: config.image.queue,
        tiles: config.console.tiles(),
        troubles,
    })
}

fn gate_settings(config: &Config) -> GateSettings {
    GateSettings {
        body_limit_bytes: config.server.body_limit_bytes,
        bodies_limit_bytes: config.server.bodies_limit_bytes,
        body_timeout: Duration::from_secs(config.server.body_timeout_s),
        body_pause: Duration::from_secs(config.server.body_pause_s),
        request_timeout: config.server.request_timeout(),
        max_wait: Duration::from_secs(config.jobs.max_wait_s),
        max_requests: config.server.max_requests,
        max_streams: config.server.max_streams,
        stream_idle: Duration::from_secs(config.server.stream_idle_s),
        bulk_memory_bytes: config.bulk.memory_bytes,
        keys_required: config.keys_required(),
    }
}

fn retention(config: &Config) -> RetentionSettings {
    let keep = Duration::from_secs(u64::from(config.jobs.keep_days) * 24 * 3600);
    RetentionSettings {
        keep: Some(keep).filter(|keep| !keep.is_zero()),
        most: Some(config.jobs.keep_count).filter(|most| *most > 0),
        settle: Duration::from_secs(config.jobs.max_wait_s),
        pause: Duration::from_secs(config.jobs.sweep_s),
        batch: config.jobs.sweep_batch,
        usage_days: config.data.usage_days,
        once: once(config),
    }
}

fn once(config: &Config) -> IdempotencySettings {
    IdempotencySettings {
        keep: Duration::from_secs(u64::from(config.idempotency.keep_hours) * 3600),
        most: config.idempotency.max,
    }
}

/// What a server is made of.
pub struct Parts {
    /// The use cases.
    pub service: Service,
    /// Those who refine jobs.
    pub workers: Vec<Worker>,
    /// Whoever decodes, infers and compares; to be waited for before the process ends.
    pub pools: [CpuPool; 2],
    /// The parts that further refiners can be built from.
    pub refiners: RefinerContext,
}

/// Opens the store, loads the model, and puts the service together. Blocks.
pub fn build(config: &Config, metrics: Arc<Metrics>) -> anyhow::Result<Parts> {
    let process = Uuid::now_v7();
    let OpenStore { store, shared } = open_store(config, process)?;
    let (models, why) = models(config)?;
    let admission = config.image.admission(config.model.layout());
    // Whoever comes to the pool has a permit, so that it need not refuse anybody.
    let pool = CpuPool::new("frames", config.image.decode_threads(), admission.permits)?;
    let job_pace = JobServiceTime::default();
    // Beside the workers, calibration and whoever looks at matches come to it, one at a time each.
    let refining = CpuPool::new("refine", config.jobs.workers.max(1), config.jobs.workers + 2)?;
    let pools = [pool.clone(), refining.clone()];
    let dense = Arc::new(DenseCache::new(config.refine.dense_cache_bytes));
    let refiners = RefinerContext {
        store: store.clone(),
        shared: shared.clone(),
        models: models.clone(),
        dense: Arc::clone(&dense),
        pool: refining,
        metrics: Arc::clone(&metrics.refine),
        settings: config.refiner_settings(),
    };
    let refiner: Option<Arc<dyn Refiner>> = match config.refine.refiner.entry() {
        Some(entry) => Some(Handle::current().block_on((entry.build)(&refiners))?),
        None => None,
    };
    let jobs: Arc<dyn JobStore> = store.clone();
    let workers = refiner.iter().flat_map(|refiner| {
        (0..config.jobs.workers).map(|_| Worker {
            jobs: Arc::clone(&jobs),
            maps: store.clone(),
            refiner: Arc::clone(refiner),
            metrics: Arc::clone(&metrics.refine),
            service_time: Arc::clone(&job_pace),
            settings: WorkerSettings {
                lease: Duration::from_secs(config.jobs.lease_s),
                timeout: Duration::from_secs(config.jobs.timeout_s),
                attempts: attempts(config),
                known_confidence: config.localize.known_confidence,
                workers: config.jobs.workers,
            },
        })
    });
    let workers = workers.collect();
    let mut keys = Handle::current().block_on(Keys::load(store.clone()))?;
    keys.limits = Limits::new(TokenBuckets::new(shared));
    check_keys(config, &keys)?;
    let service = Service {
        keys,
        webhooks: Webhooks { store: store.clone(), settings: config.webhooks.clone() },
        answers: store.clone(),
        process,
        maps: store.clone(),
        drafts: store.clone(),
        reindexes: Reindexes::default(),
        tracks: Tracks::new(config.track.clone()),
        exports: store.clone(),
        blobs: store.clone(),
        jobs,
        accounts: store.clone(),
        retention: store.clone(),
        models,
        recall: RecallCheck::new(
            Some(Duration::from_secs(config.index.check_s)).filter(|pause| !pause.is_zero()),
        ),
        admission: Admission::new(admission),
        pool,
        job_pace,
        refiner,
        dense,
        metrics: Arc::clone(&metrics.service),
        settings: ServiceSettings {
            k: config.localize.k,
            max_k: config.localize.max_k,
            known_confidence: config.localize.known_confidence,
            calibration: CalibrationSettings {
                images: config.confidence.images,
                refined: config.confidence.refined,
                candidates: config.compared_candidates(),
                place_images: config.confidence.place_images,
                place_m: config.confidence.place_m,
            },
            candidates: config.compared_candidates(),
            job_queue: config.jobs.queue,
            shed_jobs_at: config.jobs.shed_at,
            max_wait: Duration::from_secs(config.jobs.max_wait_s),
            usage_days: config.data.usage_days,
            once: once(config),
            bulk: config.bulk,
        },
        matching: Semaphore::new(1),
        searching: Semaphore::new(1),
    };
    let model = service.models.default_model();
    tracing::info!(model, %why, "the model of maps that name none");
    service.models.manifest(model)?;
    Handle::current().block_on(service.installed_model(model))?;
    Ok(Parts { service, workers, pools, refiners })
}

/// How often a refinement is attempted.
pub fn attempts(config: &Config) -> AttemptPolicy {
    AttemptPolicy {
        attempts: config.jobs.attempts,
        pause: Duration::from_secs(config.jobs.retry_pause_s),
        longest_pause: Duration::MAX,
    }
}

/// Says whether callers need a key; a server that nobody could use does not start.
fn check_keys(config: &Config, keys: &Keys) -> anyhow::Result<()> {
    let listen = config.server.listen;
    match (config.keys_required(), keys.any_valid()) {
        (true, true) => tracing::info!("callers need a key"),
        (true, false) => anyhow::bail!(
            "callers of {listen} need a key, and there is none: make the first with `whereabouts keys \
             create --data {} --role admin --name NAME`, or start with --no-keys if whoever reaches the \
             server may do everything",
            config.data.dir.display()
        ),
        (false, _) if listen.ip().is_loopback() => {
            tracing::info!("callers need no key, as the server listens on loopback only");
        }
        (false, _) => tracing::warn!(
            "NO KEYS: whoever reaches {listen} may read, change and delete everything; leave --no-keys out \
             (auth.keys) to ask for keys"
        ),
    }
    Ok(())
}

/// No model yet, and why the default one is what it is.
fn models(config: &Config) -> anyhow::Result<(LoadedModels, WhyModel)> {
    let assets = Assets::locate(config.model.assets());
    let (model, why) = assets.resolve(&config.model.name)?;
    let extractor = ExtractorSettings {
        model,
        preference: config.model.preference(),
        choice_file: None,
        layout: config.model.layout(),
        limits: config.image.limits(),
        exact_decode: config.image.exact,
    };
    let (max_loaded, choice_dir) = (config.model.loaded, config.data.dir.clone());
    Ok((LoadedModels::new(assets, LoadedSettings { max_loaded, choice_dir, extractor }), why))
}
