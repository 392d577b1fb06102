//! `/localize`.

use axum::extract::{Request, State};
use axum::{Extension, Json};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::body::{Params, PictureBody};
use super::maps::map_name;
use super::pixels::PixelParams;
use super::state::AppState;
use super::words;
use crate::gate::IdempotencyId;
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{Answer, RefineMode, WordsAnswer, WordsRequest};
use whereabouts_core::{Priority, RefinerKind, moment};
use whereabouts_service::{
    Deadline, LocalizeRequest, Odometry, Principal, ServiceError, TrackStep, WordsQuery,
};
use whereabouts_vision::{AdmissionRequest, WorkClass};

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct LocalizeParams {
    /// The map to search.
    map: String,
    /// Number of candidates, 1 to 100.
    k: Option<usize>,
    /// A description of the place instead of a frame, above all what signs say: at most 500 characters. The body is then
    /// empty. A description in the body, as JSON, is the same.
    text: Option<String>,
    /// `async` (default): a job refines the candidates in the background. `wait`: the answer waits for the
    /// job. `off`: no job.
    #[serde(default)]
    refine: RefineMode,
    /// The refiner of the job: `local`, `cascade` or `mllm`, of those that the server allows (`refine.refiner`,
    /// `refine.allowed`), and that costs no more than that of the map. By default that of the map, or of the server.
    refiner: Option<RefinerKind>,
    /// Priority of the job: before all others (`high`), in its turn (`normal`, default), or
    /// when no other job is queued (`low`).
    #[serde(default)]
    priority: Priority,
    /// Id of a track, the sequence of frames of one robot, chosen by the client: 1 to 64 letters, digits, `-`,
    /// `_`, `.` and `:`. The field `track` of the answer then estimates where the robot is, given all its
    /// frames. The images of the map need poses. A track expires when no frame arrives for a while.
    track: Option<String>,
    /// When the frame was taken, for a frame with `track`: RFC 3339 with an offset, or seconds since 1970. By
    /// default unknown: frames are then followed at their own rate, and not by the clock.
    #[param(value_type = Option<String>)]
    #[serde(default, deserialize_with = "moment::optional")]
    captured_at: Option<Timestamp>,
    /// Metres that the robot has moved since the previous frame, by its odometry, for a frame with
    /// `track`; by default, any distance up to the maximum speed (`track.max_speed_m_s`) is possible.
    moved_m: Option<f64>,
    /// Instead of `moved_m`: metres that the robot has moved ahead since the previous frame, in its own axes at that
    /// frame. `dy` and `dyaw` must be given too.
    dx: Option<f64>,
    /// Metres moved to the left.
    dy: Option<f64>,
    /// Radians turned to the left.
    dyaw: Option<f64>,
    /// The covariance of `dx`, `dy` and `dyaw`, in m², m·rad and rad²: 9 numbers row by row, or the 3 of its diagonal,
    /// separated by commas.
    covariance: Option<String>,
    /// If the body is pixels without a file format, their layout: `mono8`, `mono16` (little-endian), `rgb8`, `bgr8`,
    /// `rgba8` or `bgra8`.
    encoding: Option<String>,
    /// With `encoding`: pixels in a row.
    width: Option<u32>,
    /// With `encoding`: number of rows.
    height: Option<u32>,
    /// With `encoding`: bytes from one row to the next; by default rows follow each other without padding.
    step: Option<u64>,
}

impl LocalizeParams {
    fn step(&mut self, caller: &Principal) -> Result<Option<TrackStep>, ServiceError> {
        match self.track.take() {
            Some(id) => {
                let odometry = self.odometry()?;
                TrackStep::new(caller, id, self.captured_at, odometry).map(Some)
            }
            None if self.captured_at.is_some() || self.has_odometry() => {
                Err(ServiceError::unprocessable(
                    "captured_at, moved_m, dx, dy, dyaw and covariance need a track; set track too",
                ))
            }
            None => Ok(None),
        }
    }

    /// Refuses what a description cannot have.
    fn check_words(&self) -> Result<(), ServiceError> {
        let given = [
            ("refiner", self.refiner.is_some()),
            ("refine=wait", self.refine == RefineMode::Wait),
            ("track", self.track.is_some()),
            ("captured_at", self.captured_at.is_some()),
            ("odometry", self.has_odometry()),
            ("encoding", self.encoding.is_some()),
        ];
        match given.iter().find(|(_, is_given)| *is_given) {
            Some((name, _)) => Err(ServiceError::unprocessable(format!(
                "{name} is for frames; a description has no job, no track and no pixels. Leave it out"
            ))),
            None => Ok(()),
        }
    }

    fn has_odometry(&self) -> bool {
        let numbers = [self.moved_m, self.dx, self.dy, self.dyaw];
        numbers.iter().any(Option::is_some) || self.covariance.is_some()
    }

    fn odometry(&self) -> Result<Option<Odometry>, ServiceError> {
        if !self.has_odometry() {
            return Ok(None);
        }
        match (self.moved_m, self.dx, self.dy, self.dyaw, &self.covariance) {
            (Some(metres), None, None, None, None) => Odometry::distance(metres).map(Some),
            (None, Some(dx), Some(dy), Some(dyaw), covariance) => {
                let covariance = numbers(covariance.as_deref().unwrap_or_default())?;
                Odometry::relative_pose([dx, dy, dyaw], &covariance).map(Some)
            }
            _ => Err(ServiceError::unprocessable(
                "odometry is either moved_m alone, or dx, dy and dyaw together, with covariance if it is known",
            )),
        }
    }
}

/// Numbers separated by commas.
fn numbers(text: &str) -> Result<Vec<f64>, ServiceError> {
    let parts = text.split(',').filter(|part| !part.trim().is_empty());
    let number = |part: &str| {
        part.trim().parse().map_err(|_| {
            ServiceError::unprocessable(format!(
                "{part:?} in covariance is not a number; send 9 or 3 numbers separated by commas"
            ))
        })
    };
    parts.map(number).collect()
}

/// The form of a frame.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "describes the form; the body is read part by part")]
struct FrameForm {
    /// The frame.
    #[schema(value_type = String, format = Binary)]
    image: Vec<u8>,
}

/// What `/localize` answers.
#[derive(Serialize, ToSchema)]
#[serde(untagged)]
pub(super) enum LocalizeAnswer {
    /// Of a frame.
    Frame(Box<Answer>),
    /// Of a description.
    Words(Box<WordsAnswer>),
}

/// Localize a frame, or a description in words
///
/// Answers with the most similar images of the map. A job then compares the frame with the first of them
/// (`refine.local_candidates` or `refine.candidates`, independent of `k`) and ranks those again. Under load,
/// jobs are shed before frames: `refine=async` then answers with `job: null` and the reason in `no_job`, and
/// `refine=wait` answers 429.
///
/// With `text`, or a JSON body, the place is searched for by the signs that the description names, among those that were
/// read in the images of the map. There is no job, and the answer is a `WordsAnswer`.
#[utoipa::path(post, path = "/localize", tag = "localize", 
    params(LocalizeParams, ("X-Deadline-Ms" = Option<u32>, Header, minimum = 1, maximum = 3_600_000,
        description = "Milliseconds from arrival that the client waits for the answer. A request that \
                       cannot be answered in time is rejected with 429 at once, and one whose deadline \
                       passes is abandoned with 504. With refine=wait, the answer is sent in time, \
                       refined or not.")),
    request_body(content(
        (Vec<u8> = "image/jpeg"), (Vec<u8> = "image/png"), (Vec<u8> = "image/*"),
        (FrameForm = "multipart/form-data"), (WordsRequest = "application/json"),
    )),
    responses(
        (status = 200, body = LocalizeAnswer),
        (status = 400, body = Problem, description = "Malformed, or an empty body", content_type = "application/problem+json"),
        (status = 403, body = Problem, description = "The refiner is not allowed, or may cost more than that of the map", content_type = "application/problem+json"),
        (status = 404, body = Problem, description = "No such map", content_type = "application/problem+json"),
        (status = 409, body = Problem, description = "The map's model is not installed, or has changed meanwhile; or no text was read in the map", content_type = "application/problem+json"),
        (status = 408, body = Problem, description = "The body arrived too slowly", content_type = "application/problem+json"),
        (status = 413, body = Problem, description = "Too large", content_type = "application/problem+json"),
        (status = 415, body = Problem, description = "Not a supported image type", content_type = "application/problem+json"),
        (status = 422, body = Problem, description = "Cannot be decoded, k or a parameter of the track out of range, or a track in a map without poses", content_type = "application/problem+json"),
        (status = 429, body = Problem, description = "Overloaded; Retry-After says when to try again", content_type = "application/problem+json"),
        (status = 504, body = Problem, description = "X-Deadline-Ms has passed", content_type = "application/problem+json"),
    ))]
pub(super) async fn localize(
    State(state): State<AppState>,
    Ready(service): Ready,
    Extension(caller): Extension<Principal>,
    Params(mut params): Params<LocalizeParams>,
    Deadline(deadline): Deadline,
    request: Request,
) -> Result<Json<LocalizeAnswer>, Problem> {
    let (words, request) = words::of(params.text.take(), request, &state).await?;
    if let Some(text) = words {
        params.check_words()?;
        let query = WordsQuery { map: map_name(&params.map)?, text, k: params.k };
        let answer = service.words.localize(query).await?;
        return Ok(Json(LocalizeAnswer::Words(Box::new(answer))));
    }
    let idempotency_id =
        request.extensions().get().map(|IdempotencyId(id): &IdempotencyId| id.clone());
    let map = map_name(&params.map)?;
    let track = params.step(&caller)?;
    let demand = AdmissionRequest { class: WorkClass::Localize, deadline };
    let LocalizeParams { width, height, step, .. } = params;
    let pixels = PixelParams { encoding: params.encoding.as_deref(), width, height, step };
    let layout = pixels.layout()?;
    let body = PictureBody::read(request, &state, &service, demand, layout).await?;
    let request = LocalizeRequest {
        map,
        k: params.k,
        refine: params.refine,
        refiner: params.refiner,
        priority: params.priority,
        frame: body.picture,
        deadline,
        track,
        idempotency_id,
    };
    let answer = service.localizer.localize(request).await?;
    Ok(Json(LocalizeAnswer::Frame(Box::new(answer))))
}
