//! The tracks of robots: where each is, and the way that it took.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ImageId, MapName, Pose};

/// A robot that sends the frames of a track.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackSummary {
    /// Id of the track.
    pub id: String,
    /// Id of the API key whose robot sends it; null without keys.
    #[schema(nullable)]
    pub key: Option<String>,
    /// Number of frames so far.
    pub frames: u64,
    /// When the last frame arrived.
    #[schema(value_type = String, format = DateTime)]
    pub last_frame_at: Timestamp,
}

/// The tracks in a map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackList {
    /// Those with the latest frames first; at most 100.
    pub tracks: Vec<TrackSummary>,
}

/// The way of a robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackWay {
    /// Id of the track.
    pub id: String,
    /// The map.
    pub map: MapName,
    /// Id of the API key whose robot sends it; null without keys.
    #[schema(nullable)]
    pub key: Option<String>,
    /// Number of frames so far.
    pub frames: u64,
    /// Its places at the last `track.history` frames, the oldest first. A place that was known at the time stays as it
    /// was answered; the others are estimated from the frames before and after them.
    pub places: Vec<TrackPlace>,
}

/// Where a robot was at one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrackPlace {
    /// When the frame was taken, if the robot said so.
    #[schema(nullable, value_type = Option<String>, format = DateTime)]
    pub captured_at: Option<Timestamp>,
    /// When the frame arrived.
    #[schema(value_type = String, format = DateTime)]
    pub received_at: Timestamp,
    /// Most probable image; null while no image is likely.
    #[schema(nullable)]
    pub image_id: Option<ImageId>,
    /// Pose of that image.
    #[schema(nullable)]
    pub pose: Option<Pose>,
    /// Probability, 0 to 1, that the robot was at that image or one next to it.
    pub probability: f64,
    /// Whether it was known at the time, or the probability reaches the configured threshold at the place that was
    /// answered then.
    pub known: bool,
    /// Probability, 0 to 1, that the robot was at no place of the map.
    pub off_map: f64,
}
