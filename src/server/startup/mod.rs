//! Wiring: builds the parts, serves until shutdown, drains. The only module that knows all others.

mod store;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use jiff::Timestamp;
use tokio::net::TcpListener;
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::Metrics;
use crate::config::Config;
use crate::gate::{Connections, Gate, GateSettings};
use crate::http::{About, AppState};
use crate::router::{router, worker_router};
use whereabouts_reading::{OnnxReader, ReadError, Reader, ReaderSettings};
use whereabouts_refine::{
    DenseCache, FrameReader, JobServiceTime, Refiner, RefinerContext, RefinerSet, Worker,
};
use whereabouts_service::{
    AllowedRefiners, Dispatcher, Janitor, Keys, Limits, Reading, ReadingSettings, Service,
    ServiceParts, ServiceSettings, Webhooks,
};
use whereabouts_store::TokenBuckets;
use whereabouts_telemetry::LogIssues;
use whereabouts_vision::{Admission, CpuPool, ExtractorSettings};
use whereabouts_vision::{LoadedModels, LoadedSettings, WhyModel};

#[cfg(feature = "postgres")]
pub use self::store::postgres_settings;
pub use self::store::{OpenStore, open_store};

/// The role of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Answers requests, and refines jobs unless `jobs.workers` is 0.
    Serve,
    /// Refines jobs, and answers health checks and metrics only.
    Worker,
}

/// Serves on `listener` until `shutdown`, then drains. `on_ready` runs once `/readyz` answers 200; `issues` are
/// the recent warnings and errors of the log.
pub async fn run(
    role: Role,
    config: Config,
    issues: Arc<LogIssues>,
    listener: TcpListener,
    shutdown: CancellationToken,
    on_ready: impl FnOnce(SocketAddr) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let address = listener.local_addr().context("the listener has no address")?;
    let metrics = Arc::new(Metrics::new());
    let gate = Gate::new(gate_settings(&config), Arc::clone(&metrics));
    let state = AppState { gate, about: Arc::new(about(&config, issues)?) };
    let connections = Connections {
        settings: config.server.clone(),
        router: match role {
            Role::Serve => router(state.clone()),
            Role::Worker => worker_router(state.clone()),
        },
        metrics: Arc::clone(&metrics),
        tls: config.server.tls()?.map(Arc::new),
    };
    let encrypted = connections.tls.is_some();
    let server = tokio::spawn(connections.serve(listener, shutdown.clone()));
    let (drain_timeout, jobs) = (config.server.drain_timeout, config.jobs);
    let (idempotency, usage_days) = (config.idempotency, config.data.usage_days);
    let counted = Arc::clone(&metrics.service);
    let building = tokio::task::spawn_blocking(move || build(&config, metrics));
    let Parts { service, worker, pools, .. } = building.await.context("the start failed")??;
    let janitor = Janitor {
        store: Arc::clone(&service.retention),
        answers: Arc::clone(&service.idempotency.store),
        metrics: Arc::clone(&counted),
        jobs,
        usage_days,
        idempotency,
    };
    let Webhooks { store, settings } = &service.webhooks;
    let dispatcher = Dispatcher::new(Arc::clone(store), counted, settings.clone());
    let service = Arc::new(service);
    state.gate.readiness().open(Arc::clone(&service));
    let tracked = Arc::clone(&service);
    let mut running = JoinSet::new();
    if role == Role::Serve {
        let until = shutdown.clone();
        running.spawn(async move { janitor.run(until).await });
        running.spawn(dispatcher.run(shutdown.clone()));
        let until = shutdown.clone();
        let fitting = Arc::clone(&service);
        running.spawn(async move { service.calibrator.run(until).await });
        let until = shutdown.clone();
        running.spawn(async move { fitting.fitter.run(until).await });
        let (until, reading) = (shutdown.clone(), Arc::clone(&tracked.reading));
        running.spawn(async move { reading.run(until).await });
        let (until, saving) = (shutdown.clone(), Arc::clone(&tracked));
        running.spawn(async move { saving.localizer.tracks.run(until).await });
        let (until, heeding) = (shutdown.clone(), Arc::clone(&tracked));
        running.spawn(async move {
            heeding.localizer.tracks.heed(&heeding.localizer.jobs, until).await;
        });
    }
    if let Some(worker) = worker {
        running.spawn(worker.run(shutdown.clone()));
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
        Ok(served) => served.context("the server failed")?,
        Err(_) => tracing::warn!(
            seconds = drain_timeout.as_secs(),
            "requests were still in progress when the drain timed out"
        ),
    }
    let idle = move || pools.iter().for_each(|pool| pool.wait_until_idle(drain_timeout));
    tokio::task::spawn_blocking(idle).await.context("the shutdown failed")?;
    tracked.localizer.tracks.save().await;
    tracing::info!("stopped");
    Ok(())
}

fn about(config: &Config, issues: Arc<LogIssues>) -> anyhow::Result<About> {
    Ok(About {
        started_at: Timestamp::now(),
        settings: toml::to_string(config)?,
        pictures: config.image.queue,
        tiles: config.console.tiles(),
        troubles: issues,
    })
}

/// The settings of the gate, which come from several sections.
fn gate_settings(config: &Config) -> GateSettings {
    GateSettings {
        server: config.server.clone(),
        max_wait: config.jobs.max_wait,
        bulk_memory_bytes: config.bulk.memory_bytes,
        keys_required: config.keys_required(),
    }
}

/// The sections that the use cases own.
fn service_settings(config: &Config) -> ServiceSettings {
    let recall_check = Duration::from_secs(config.index.check_s);
    ServiceSettings {
        localize: config.localize,
        track: config.track.clone(),
        confidence: config.confidence,
        vocabulary: config.vocabulary,
        jobs: config.jobs,
        refiners: allowed_refiners(config),
        compared: config.compared_candidates(),
        recall_check: Some(recall_check).filter(|pause| !pause.is_zero()),
        usage_days: config.data.usage_days,
        idempotency: config.idempotency,
        bulk: config.bulk,
        webhooks: config.webhooks.clone(),
    }
}

/// The refiners that maps and requests may choose.
fn allowed_refiners(config: &Config) -> AllowedRefiners {
    let settings = config.refiner_settings();
    let allowed = config.allowed_refiners().into_iter();
    AllowedRefiners {
        default: config.refine.refiner.kind(),
        allowed: allowed.map(|entry| (entry.kind, (entry.candidates)(&settings))).collect(),
    }
}

/// The parts of a running process.
pub struct Parts {
    /// The use cases.
    pub service: Service,
    /// Refines jobs, if this process is to.
    pub worker: Option<Worker>,
    /// Pools that decode, compare and read. The process waits for them before it exits.
    pub pools: [CpuPool; 3],
    /// The parts that further refiners can be built from.
    pub refiners: RefinerContext,
}

/// Opens the store, loads the model and wires the service. Blocks.
pub fn build(config: &Config, metrics: Arc<Metrics>) -> anyhow::Result<Parts> {
    let process = Uuid::now_v7();
    let OpenStore { store, shared } = open_store(config, process)?;
    let (models, why) = models(config)?;
    let admission = config.image.admission(config.model.layout());
    // Every task of this pool holds a permit, so its queue never overflows.
    let pool = CpuPool::new("frames", config.image.decode_threads(), admission.permits)?;
    let job_service_time = JobServiceTime::default();
    // Besides jobs, of which as many as there are threads use it, by themselves or in place of another refiner,
    // calibration and the display of matches use it, one task at a time each.
    let refining = CpuPool::new("refine", config.jobs.workers.max(1), config.jobs.workers + 2)?;
    let admission = Admission::new(admission);
    let reading = Arc::new(Reading::new(
        reader(config),
        store.clone(),
        admission.clone(),
        config.image.limits(),
        Arc::clone(&metrics.service),
    )?);
    let pools = [pool.clone(), refining.clone(), reading.pool()];
    let dense = Arc::new(DenseCache::new(config.refine.dense_cache_bytes));
    let refiners = RefinerContext {
        store: store.clone(),
        shared: shared.clone(),
        models: models.clone(),
        dense: Arc::clone(&dense),
        pool: refining,
        metrics: Arc::clone(&metrics.refine),
        settings: config.refiner_settings(),
        model: Arc::default(),
    };
    let mut built = Vec::new();
    for entry in config.allowed_refiners() {
        built.push(Handle::current().block_on((entry.build)(&refiners))?);
    }
    let mut built = built.into_iter();
    let refiner: Option<Arc<dyn Refiner>> = built
        .next()
        .map(|first| Arc::new(RefinerSet::new(first, built.collect())) as Arc<dyn Refiner>);
    let refines = refiner.as_ref().filter(|_| config.jobs.workers > 0);
    let worker = refines.map(|refiner| Worker {
        jobs: store.clone(),
        maps: store.clone(),
        refiner: Arc::clone(refiner),
        reader: reading.is_installed().then(|| Arc::clone(&reading) as Arc<dyn FrameReader>),
        metrics: Arc::clone(&metrics.refine),
        service_time: Arc::clone(&job_service_time),
        settings: config.jobs,
        known_confidence: config.localize.known_confidence,
    });
    let mut keys = Handle::current().block_on(Keys::load(store.clone()))?;
    keys.limits = Limits::new(TokenBuckets::new(shared));
    check_keys(config, &keys)?;
    let parts = ServiceParts {
        store,
        process,
        keys,
        models,
        admission,
        reading,
        pool,
        refiner,
        dense,
        job_service_time,
        metrics: Arc::clone(&metrics.service),
    };
    let service = Service::new(parts, service_settings(config));
    let model = service.maps.imaging.models.default_model();
    tracing::info!(model, %why, "the model of maps that name none");
    service.maps.imaging.models.manifest(model)?;
    Handle::current().block_on(service.maps.imaging.installed_model(model))?;
    Ok(Parts { service, worker, pools, refiners })
}

/// Logs whether callers need an API key. Fails if they need one and there is none.
fn check_keys(config: &Config, keys: &Keys) -> anyhow::Result<()> {
    let listen = config.server.listen;
    match (config.keys_required(), keys.any_valid()) {
        (true, true) => tracing::info!("callers need a key"),
        (true, false) => anyhow::bail!(
            "callers of {listen} need a key, and there is none: make the first with `whereabouts keys \
             create --data {} --role admin --name NAME`, or start with --no-keys if anyone who can reach the \
             server may do everything",
            config.data.dir.display()
        ),
        (false, _) if listen.ip().is_loopback() => {
            tracing::info!("callers need no key, as the server listens on loopback only");
        }
        (false, _) => tracing::warn!(
            "NO KEYS: anyone who can reach {listen} may read, change and delete everything; leave --no-keys out \
             (auth.keys) to ask for keys"
        ),
    }
    Ok(())
}

/// The reader of text in pictures, if it is configured and installed. Everything else works without.
fn reader(config: &Config) -> Option<Arc<dyn Reader>> {
    let ReadingSettings { reader: name, threads, max_lines } = config.reading.clone();
    if name.is_empty() {
        return None;
    }
    let settings = ReaderSettings { name, threads, max_lines };
    match OnnxReader::load(&config.model.installed_in(None), &settings) {
        Ok(reader) => {
            tracing::info!(reader = settings.name, "text in pictures is read");
            Some(Arc::new(reader))
        }
        Err(why @ ReadError::NotInstalled { .. }) => {
            tracing::info!(%why, "text in pictures is not read");
            None
        }
        Err(error) => {
            tracing::error!(%error, "text in pictures is not read");
            None
        }
    }
}

/// The models, none of them loaded yet, and why the default one was chosen.
fn models(config: &Config) -> anyhow::Result<(LoadedModels, WhyModel)> {
    let assets = config.model.installed_in(None);
    for model in config.model.sizes.models().filter(|model| assets.model(model).is_err()) {
        tracing::warn!(model, "model.sizes names a model that is not installed");
    }
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
