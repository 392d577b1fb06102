//! `/status`: how the server stands, for the people who look after it.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::problem::Problem;
use super::state::{AppState, Ready};
use whereabouts_api::Today;
use whereabouts_core::RefinerKind;
use whereabouts_service::ServiceError;
use whereabouts_telemetry::{LogIssue, LogIssues, Minute};

/// What is known of the server from its start on.
#[derive(Debug)]
pub struct About {
    /// When it was started.
    pub started_at: Timestamp,
    /// The settings in force in TOML, without secrets.
    pub settings: String,
    /// Pictures that may wait.
    pub pictures: usize,
    /// The pictures behind the plan of a map, if there are any.
    pub tiles: Option<Tiles>,
    /// The last warnings and errors.
    pub troubles: Arc<LogIssues>,
}

/// A server of map tiles.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct Tiles {
    /// An address with `{z}`, `{x}` and `{y}` (Web Mercator, as OpenStreetMap has it).
    pub url: String,
    /// Whom to thank for them.
    pub attribution: String,
}

/// How the server stands.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Status {
    /// Its version.
    version: &'static str,
    /// When it was started.
    started_at: Timestamp,
    /// Its clock.
    now: Timestamp,
    /// Who refines; null for nobody.
    #[schema(nullable)]
    refiner: Option<RefinerKind>,
    /// Whether callers need a key.
    keys_required: bool,
    /// The model of maps that name none.
    default_model: String,
    /// The models in memory, the most recently used first.
    models: Vec<ModelInMemory>,
    /// Jobs that wait or run.
    jobs: OpenOf,
    /// Pictures that wait to be decoded.
    pictures: OpenOf,
    /// Bytes of the record database.
    db_bytes: u64,
    /// Bytes of the disk that are free; null where that cannot be told.
    #[schema(nullable)]
    free_bytes: Option<u64>,
    /// The budget of today; null if the refiner asks no model outside.
    #[schema(nullable)]
    today: Option<Today>,
    /// The server of map tiles, if one is configured.
    #[schema(nullable)]
    tiles: Option<Tiles>,
    /// The last hour, the oldest minute first; minutes in which nothing was done are left out.
    minutes: Vec<Minute>,
    /// The last warnings and errors of the log, the newest first.
    errors: Vec<LogIssue>,
    /// The settings in force in TOML, without secrets.
    settings: String,
}

/// How many there are.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct OpenOf {
    /// Now.
    open: usize,
    /// At the most.
    limit: usize,
}

/// A model in memory.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ModelInMemory {
    /// Its name.
    name: String,
    /// Who runs it.
    provider: String,
    /// At which precision.
    precision: String,
}

/// How the server stands
///
/// What it is doing, the last hour minute by minute, the last warnings and errors, and the settings in force.
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
        keys_required: state.settings.keys_required,
        default_model: service.maps.imaging.models.default_model().to_owned(),
        models: models.collect(),
        jobs: OpenOf { open: service.jobs.open().await?, limit: service.localizer.submitter.queue },
        pictures: OpenOf {
            open: waiting.localize + waiting.index + waiting.background,
            limit: about.pictures,
        },
        db_bytes,
        free_bytes: service.retention.free_bytes().await,
        today: service.usage.today(),
        tiles: about.tiles.clone(),
        minutes: state.metrics.last_hour.minutes(now),
        errors: about.troubles.last(),
        settings: about.settings.clone(),
    }))
}
