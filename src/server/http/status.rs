//! `/status`: the state of the server, for its operators.

use axum::Json;
use axum::extract::State;
use jiff::Timestamp;
use serde::Serialize;
use utoipa::ToSchema;

use super::state::{AppState, Tiles};
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::Today;
use whereabouts_core::{ModelServer, RefinerKind};
use whereabouts_service::ServiceError;
use whereabouts_telemetry::{LogIssue, Minute};

/// State of the server.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Status {
    /// Version of the server.
    version: &'static str,
    /// When the process started.
    started_at: Timestamp,
    /// Current time of the server.
    now: Timestamp,
    /// The refiner; null if none is configured.
    #[schema(nullable)]
    refiner: Option<RefinerKind>,
    /// Whether callers need a key.
    keys_required: bool,
    /// Default model, used by maps that name none.
    default_model: String,
    /// Models in memory, most recently used first.
    models: Vec<ModelInMemory>,
    /// Jobs queued or running.
    jobs: OpenOf,
    /// Pictures waiting to be decoded.
    pictures: OpenOf,
    /// Size of the record database, in bytes.
    db_bytes: u64,
    /// Free disk space, in bytes; null if it cannot be determined.
    #[schema(nullable)]
    free_bytes: Option<u64>,
    /// Budget of today; null if the refiner calls no external model.
    #[schema(nullable)]
    today: Option<Today>,
    /// Servers of multimodal models that the refiner uses: whether they answer, why not, and what they can do.
    model_servers: Vec<ModelServer>,
    /// The server of map tiles, if one is configured.
    #[schema(nullable)]
    tiles: Option<Tiles>,
    /// The last hour, oldest minute first; minutes without activity are omitted.
    minutes: Vec<Minute>,
    /// Latest warnings and errors of the log, newest first.
    errors: Vec<LogIssue>,
    /// Effective settings in TOML, without secrets.
    settings: String,
}

/// Occupancy of a bounded queue.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct OpenOf {
    /// Current number.
    open: usize,
    /// Upper bound.
    limit: usize,
}

/// A model in memory.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ModelInMemory {
    /// Name of the model.
    name: String,
    /// Execution provider.
    provider: String,
    /// Precision of the weights.
    precision: String,
}

/// State of the server
///
/// Current load, statistics of the last hour by minute, the latest warnings and errors, and the effective
/// settings.
#[utoipa::path(get, path = "/status", tag = "service", responses((status = 200, body = Status)))]
pub(super) async fn status(
    State(state): State<AppState>,
    Ready(service): Ready,
) -> Result<Json<Status>, Problem> {
    let now = Timestamp::now();
    let db_bytes = service.retention.db_bytes().await.map_err(ServiceError::from)?;
    let waiting = service.maps.imaging.admission.levels();
    let models = service.maps.imaging.models.in_memory().into_iter().map(|(name, execution)| {
        ModelInMemory {
            name,
            provider: execution.provider.to_string(),
            precision: execution.precision.to_string(),
        }
    });
    let about = &state.about;
    Ok(Json(Status {
        version: env!("CARGO_PKG_VERSION"),
        started_at: about.started_at,
        now,
        refiner: service.jobs.refiner.as_ref().map(|refiner| refiner.kind()),
        keys_required: state.gate.settings.keys_required,
        default_model: service.maps.imaging.models.default_model().to_owned(),
        models: models.collect(),
        jobs: OpenOf {
            open: service.jobs.open().await?,
            limit: service.localizer.submitter.settings.queue,
        },
        pictures: OpenOf {
            open: waiting.localize + waiting.index + waiting.background,
            limit: about.pictures,
        },
        db_bytes,
        free_bytes: service.retention.free_bytes().await,
        today: service.usage.today(),
        model_servers: service.usage.model_servers(),
        tiles: about.tiles.clone(),
        minutes: state.gate.metrics.last_hour.minutes(now),
        errors: about.troubles.last(),
        settings: about.settings.clone(),
    }))
}
