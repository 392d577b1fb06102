//! The only place where everything is wired: build, serve, drain.

mod settings;
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
use crate::config::{Config, Refiner as ConfiguredRefiner, cores_unless};
use crate::http::{About, AppState, Connections, router, worker_router};
use whereabouts_core::utc_day;
use whereabouts_refine::local::{LocalMatcher, LocalSettings};
use whereabouts_refine::mllm::{MllmParts, MllmRefiner};
use whereabouts_refine::{
    DenseCache, JobServiceTime, LocalRefiner, Refiner, Worker, WorkerSettings,
};
use whereabouts_service::{Dispatcher, Janitor, Keys, Limits, Service, ServiceParts, Webhooks};
use whereabouts_store::Buckets;
use whereabouts_telemetry::LogIssues;
use whereabouts_vision::{Admission, Assets, CpuPool, ExtractorSettings, ImageLimits};
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
    let state =
        AppState::new(settings::http(&config), about(&config, troubles)?, Arc::clone(&metrics));
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
    let (drain_timeout, retention) = (config.server.drain_timeout(), settings::retention(&config));
    let counted = Arc::clone(&metrics.service);
    let building = tokio::task::spawn_blocking(move || build(&config, metrics));
    let Parts { service, workers, pools } = building.await.context("the start broke off")??;
    let janitor = Janitor {
        store: Arc::clone(&service.retention),
        answers: Arc::clone(&service.idempotency.store),
        metrics: Arc::clone(&counted),
        settings: retention,
    };
    let Webhooks { store, settings } = &service.webhooks;
    let dispatcher = Dispatcher::new(Arc::clone(store), counted, settings.clone());
    let service = Arc::new(service);
    state.door().open(Arc::clone(&service));
    let mut running = JoinSet::new();
    if role == Role::Serve {
        let until = shutdown.clone();
        running.spawn(async move { janitor.run(until).await });
        running.spawn(dispatcher.run(shutdown.clone()));
        let until = shutdown.clone();
        running.spawn(async move { service.calibrator.run(until).await });
    }
    for worker in workers {
        let shutdown = shutdown.clone();
        running.spawn(async move { worker.run(shutdown).await });
    }
    on_ready(address)?;
    tracing::info!(%address, tls = encrypted, "ready");

    shutdown.cancelled().await;
    tracing::info!("draining");
    state.door().drain();
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

/// What a server is made of.
pub struct Parts {
    /// The use cases.
    pub service: Service,
    /// Those who refine jobs.
    pub workers: Vec<Worker>,
    /// Whoever decodes, infers and compares; to be waited for before the process ends.
    pub pools: [CpuPool; 2],
}

/// Opens the store, loads the model, and puts the service together. Blocks.
pub fn build(config: &Config, metrics: Arc<Metrics>) -> anyhow::Result<Parts> {
    let process = Uuid::now_v7();
    let OpenStore { store, shared } = open_store(config, process)?;
    let (models, why) = models(config)?;
    let admission = config.image.admission(config.model.layout());
    // Whoever comes to the pool has a permit, so that it need not refuse anybody.
    let pool = CpuPool::new("frames", cores_unless(config.image.threads), admission.permits)?;
    let job_service_time = JobServiceTime::default();
    // Beside the workers, calibration and whoever looks at matches come to it, one at a time each.
    let refining = CpuPool::new("refine", config.jobs.workers.max(1), config.jobs.workers + 2)?;
    let pools = [pool.clone(), refining.clone()];
    let dense = Arc::new(DenseCache::new(config.refine.dense_cache_bytes));
    let local = Arc::new(LocalRefiner {
        maps: store.clone(),
        blobs: store.clone(),
        models: models.clone(),
        dense: Arc::clone(&dense),
        pool: refining,
        matcher: LocalMatcher::new(LocalSettings::default()),
    });
    let refiner: Option<Arc<dyn Refiner>> = match config.refine.refiner {
        ConfiguredRefiner::Off => None,
        ConfiguredRefiner::Local => Some(local),
        ConfiguredRefiner::Mllm => {
            let parts = MllmParts {
                maps: store.clone(),
                blobs: store.clone(),
                cache: store.clone(),
                usage: store.clone(),
                shared: shared.clone(),
                metrics: Arc::clone(&metrics.refine),
                limits: models.limits(),
                fallback: Some(local),
            };
            let refiner = MllmRefiner::new(parts, config.mllm.clone())?;
            // Nobody else spends before the workers start.
            let today = utc_day(Timestamp::now());
            refiner.seed_spent_today(&Handle::current().block_on(store.usage(today))?);
            Some(Arc::new(refiner))
        }
    };
    let workers = refiner.iter().flat_map(|refiner| {
        (0..config.jobs.workers).map(|_| Worker {
            jobs: store.clone(),
            maps: store.clone(),
            refiner: Arc::clone(refiner),
            metrics: Arc::clone(&metrics.refine),
            pace: Arc::clone(&job_service_time),
            settings: WorkerSettings {
                lease: Duration::from_secs(config.jobs.lease_s),
                timeout: Duration::from_secs(config.jobs.timeout_s),
                attempts: config.jobs.attempts,
                retry_pause: Duration::from_secs(config.jobs.retry_pause_s),
                known_confidence: config.localize.known_confidence,
                side_by_side: config.jobs.workers,
            },
        })
    });
    let workers = workers.collect();
    let mut keys = Handle::current().block_on(Keys::load(store.clone()))?;
    keys.limits = Limits::new(Buckets::of(shared));
    check_keys(config, &keys)?;
    let parts = ServiceParts {
        store,
        process,
        keys,
        models,
        admission: Admission::new(admission),
        pool,
        refiner,
        dense,
        job_service_time,
        metrics: Arc::clone(&metrics.service),
    };
    let service = Service::new(parts, settings::service(config));
    let model = service.maps.imaging.models.default_model();
    tracing::info!(model, %why, "the model of maps that name none");
    service.maps.imaging.models.manifest(model)?;
    Handle::current().block_on(service.maps.imaging.installed_model(model))?;
    Ok(Parts { service, workers, pools })
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
    let each = ExtractorSettings {
        model,
        wanted: config.model.wanted(),
        remember: None,
        layout: config.model.layout(),
        limits: ImageLimits { max_pixels: config.image.max_pixels },
        exact_decode: config.image.exact,
    };
    let (most, remember) = (config.model.loaded, config.data.dir.clone());
    Ok((LoadedModels::new(assets, LoadedSettings { most, remember, each }), why))
}
