//! The messages of a stored track. A field keeps its number and its meaning; servers skip those that they do not know.

use prost::Message;

#[derive(Clone, PartialEq, Message)]
pub(super) struct TrackRecord {
    /// The number of states of an image: a filter with others cannot read this.
    #[prost(uint32, tag = "1")]
    pub states: u32,
    #[prost(uint32, tag = "2")]
    pub revision: u32,
    #[prost(uint64, tag = "3")]
    pub frames: u64,
    #[prost(int64, tag = "4")]
    pub last_frame_us: i64,
    #[prost(message, optional, tag = "5")]
    pub posterior: Option<PosteriorRecord>,
    #[prost(message, optional, tag = "6")]
    pub seen: Option<FramesRecord>,
    #[prost(message, optional, tag = "7")]
    pub odometer: Option<OdometerRecord>,
    #[prost(message, optional, tag = "8")]
    pub clock: Option<ClockRecord>,
    #[prost(message, repeated, tag = "9")]
    pub passed: Vec<PassedRecord>,
    #[prost(message, repeated, tag = "10")]
    pub kept: Vec<KeptRecord>,
    #[prost(message, repeated, tag = "11")]
    pub steps: Vec<StepRecord>,
}

/// Columns: the slots, the number of states of each, and those states with their probabilities.
#[derive(Clone, PartialEq, Message)]
pub(super) struct PosteriorRecord {
    #[prost(uint64, repeated, tag = "1")]
    pub slots: Vec<u64>,
    #[prost(uint32, repeated, tag = "2")]
    pub counts: Vec<u32>,
    #[prost(bytes = "vec", tag = "3")]
    pub states: Vec<u8>,
    #[prost(float, repeated, tag = "4")]
    pub masses: Vec<f32>,
    #[prost(double, repeated, tag = "5")]
    pub on: Vec<f64>,
    #[prost(double, repeated, tag = "6")]
    pub off: Vec<f64>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct FramesRecord {
    #[prost(message, optional, tag = "1")]
    pub sum: Option<VectorRecord>,
    #[prost(double, tag = "2")]
    pub weight: f64,
    #[prost(message, repeated, tag = "3")]
    pub last: Vec<VectorRecord>,
    #[prost(uint32, tag = "4")]
    pub repeated: u32,
    #[prost(double, tag = "5")]
    pub alternation: f64,
    #[prost(uint32, tag = "6")]
    pub count: u32,
    #[prost(message, optional, tag = "7")]
    pub centred: Option<VectorRecord>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct VectorRecord {
    /// What the largest 16-bit integer stands for.
    #[prost(float, tag = "1")]
    pub scale: f32,
    #[prost(bytes = "vec", tag = "2")]
    pub numbers: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct OdometerRecord {
    #[prost(double, tag = "1")]
    pub pending: f64,
    #[prost(double, tag = "2")]
    pub error: f64,
    #[prost(double, tag = "3")]
    pub turn: f64,
    #[prost(bool, tag = "4")]
    pub backwards: bool,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct ClockRecord {
    #[prost(message, optional, tag = "1")]
    pub last: Option<ReadingRecord>,
    #[prost(int64, optional, tag = "2")]
    pub before_step_us: Option<i64>,
    #[prost(message, optional, tag = "3")]
    pub older: Option<OlderRecord>,
    #[prost(double, optional, tag = "4")]
    pub arrivals: Option<f64>,
    #[prost(double, optional, tag = "5")]
    pub captures: Option<f64>,
    #[prost(uint64, tag = "6")]
    pub timed: u64,
    #[prost(uint32, tag = "7")]
    pub same: u32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct ReadingRecord {
    #[prost(int64, optional, tag = "1")]
    pub captured_us: Option<i64>,
    /// How long ago the frame arrived when this was stored.
    #[prost(double, tag = "2")]
    pub arrived_s: f64,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct OlderRecord {
    #[prost(int64, tag = "1")]
    pub first_us: i64,
    #[prost(int64, tag = "2")]
    pub newest_us: i64,
    #[prost(double, tag = "3")]
    pub arrived_s: f64,
    #[prost(uint32, tag = "4")]
    pub count: u32,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct PassedRecord {
    #[prost(int64, optional, tag = "1")]
    pub captured_us: Option<i64>,
    #[prost(int64, tag = "2")]
    pub received_us: i64,
    #[prost(uint64, repeated, tag = "3")]
    pub slots: Vec<u64>,
    #[prost(float, repeated, tag = "4")]
    pub masses: Vec<f32>,
    #[prost(double, tag = "5")]
    pub off_map: f64,
    #[prost(double, optional, tag = "6")]
    pub metres: Option<f64>,
    #[prost(double, tag = "7")]
    pub error: f64,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct KeptRecord {
    #[prost(int64, tag = "1")]
    pub captured_us: i64,
    #[prost(message, optional, tag = "2")]
    pub posterior: Option<PosteriorRecord>,
}

#[derive(Clone, PartialEq, Message)]
pub(super) struct StepRecord {
    #[prost(uint64, tag = "1")]
    pub frame: u64,
    #[prost(double, tag = "2")]
    pub max_speed: f64,
    /// The move by odometry, if there is any.
    #[prost(double, optional, tag = "3")]
    pub metres: Option<f64>,
    #[prost(double, tag = "4")]
    pub error: f64,
    #[prost(double, tag = "5")]
    pub speed: f64,
    /// The time that passed, without odometry.
    #[prost(double, optional, tag = "6")]
    pub time: Option<f64>,
    #[prost(double, optional, tag = "7")]
    pub novelty: Option<f64>,
}
