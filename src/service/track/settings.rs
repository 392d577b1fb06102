//! Bounds and parameters of tracks.

use serde::{Deserialize, Serialize};

/// Maximum speed that can be configured, in metres per second.
const MAX_SPEED_M_S: f64 = 1000.0;

/// Odometry that errs by more than this many times the distance moved says nothing.
const MAX_ODOMETRY_ERROR: f64 = 1000.0;

/// Maximum number of places of a track that can be configured: smoothing takes time for each.
const MAX_HISTORY: usize = 1000;

/// Limits of the size of a stored track, in bytes.
const MIN_STATE_BYTES: usize = 1 << 14;
const MAX_STATE_BYTES: usize = 1 << 26;

/// Limits of the exponent. Beyond them, single precision makes every image equally likely, or one certain.
const SHARPNESS: [f64; 2] = [1e-6, 1e6];

/// `[track]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackSettings {
    /// Maximum number of tracks in memory; the least recently used is evicted.
    pub max: usize,
    /// How long a track is kept after its last frame, in seconds.
    pub idle_s: u64,
    /// Maximum speed of a robot without odometry, in metres per second.
    pub max_speed_m_s: f64,
    /// Standard deviation of the odometry error, as a share of the distance moved.
    pub odometry_error: f64,
    /// Share of frames that carry no information about the place: ω of the filter.
    pub outliers: f64,
    /// Probability that a robot has turned round since its last frame.
    pub turn: f64,
    /// Probability that a robot was carried anywhere since its last frame: ε of the filter.
    pub jump: f64,
    /// Probability that a robot has left the map since its last frame, where no path ends.
    pub leave: f64,
    /// Probability that a robot off the map has come back since its last frame.
    pub enter: f64,
    /// Weight of similarity: β of the filter.
    pub sharpness: f64,
    /// Most similar images of a frame that are always considered, however unlikely they were before it.
    pub candidates: usize,
    /// Maximum number of likely images that are kept between frames.
    pub states: usize,
    /// Number of last places of each track that are kept, and smoothed when they are asked for.
    pub history: usize,
    /// Maximum number of tracks in the store; those without a frame for longest are removed.
    pub stored: usize,
    /// Maximum size of a track in the store, in bytes.
    pub state_bytes: usize,
    /// Whether the verdict of a refiner enters the track of its frame when the job ends.
    pub verdicts: bool,
    /// Minimum probability of a known place.
    pub known_probability: f64,
}

impl TrackSettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        let share = |name: &str, value: f64| {
            let wrong = !(value > 0.0 && value < 1.0);
            wrong.then(|| format!("track.{name} = {value} must be above 0 and below 1"))
        };
        let above_zero = |name: &str, value: f64| {
            let wrong = !(value > 0.0 && value.is_finite());
            wrong.then(|| format!("track.{name} = {value} must be above 0"))
        };
        if self.max_speed_m_s > MAX_SPEED_M_S {
            return Some(format!("track.max_speed_m_s must be at most {MAX_SPEED_M_S}"));
        }
        if self.history > MAX_HISTORY {
            return Some(format!("track.history must be at most {MAX_HISTORY}"));
        }
        if !(MIN_STATE_BYTES..=MAX_STATE_BYTES).contains(&self.state_bytes) {
            return Some(format!(
                "track.state_bytes must be from {MIN_STATE_BYTES} to {MAX_STATE_BYTES}"
            ));
        }
        let counts = [
            ("max", self.max),
            ("stored", self.stored),
            ("candidates", self.candidates),
            ("states", self.states),
        ];
        let zero = counts.into_iter().find(|(_, count)| *count == 0);
        zero.map(|(name, _)| format!("track.{name} must be at least 1"))
            .or_else(|| share("outliers", self.outliers))
            .or_else(|| share("turn", self.turn))
            .or_else(|| share("jump", self.jump))
            .or_else(|| share("leave", self.leave))
            .or_else(|| share("enter", self.enter))
            .or_else(|| above_zero("max_speed_m_s", self.max_speed_m_s))
            .or_else(|| above_zero("odometry_error", self.odometry_error))
            .or_else(|| {
                let wrong = self.odometry_error > MAX_ODOMETRY_ERROR;
                wrong.then(|| format!("track.odometry_error must be at most {MAX_ODOMETRY_ERROR}"))
            })
            .or_else(|| {
                let [least, most] = SHARPNESS;
                let wrong = !(least..=most).contains(&self.sharpness);
                wrong.then(|| {
                    format!("track.sharpness = {} must be from {least} to {most}", self.sharpness)
                })
            })
    }
}
