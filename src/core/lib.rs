//! The vocabulary of the service as plain types: map, image, pose, descriptor, candidate, job.
//!
//! Values are valid by construction (a [`Descriptor`] has unit norm, a [`Ranking`] is a permutation),
//! so the members above do not check again. This member does no I/O.

mod candidate;
pub mod confidence;
pub mod dense;
mod description;
mod descriptor;
mod descriptor_kind;
mod digest;
mod estimate;
mod image;
mod image_texts;
mod job;
mod key;
mod leftovers;
mod map;
mod model_server;
pub mod moment;
mod null_distribution;
mod pose;
mod resemblance;
mod secret;
mod service_time;
mod spend;
mod text_line;
pub mod text_search;
pub mod units;
mod utm;
mod verdict;
mod webhook;
pub mod words;

pub use self::image::{ExportedImage, Image, ImageField, ImageId, MediaType, Recording};
pub use candidate::{Candidate, RankedCandidate, Ranking, RankingError};
pub use confidence::{Calibration, CalibrationSettings, Evidence};
pub use dense::DenseFeatures;
pub use description::{
    CacheLevels, CachedDescription, DescribedFrame, DescriptionSubject, PairRegion, SimilarFrame,
};
pub use descriptor::{Descriptor, DescriptorError, dot};
pub use descriptor_kind::DescriptorKind;
pub use digest::Digest;
pub use estimate::Estimate;
pub use image_texts::ImageTexts;
pub use job::{
    DayUsage, Description, Job, JobState, JobVerdict, Priority, RefinerKind, StandIn, Usage,
    utc_day,
};
pub use key::{ApiKey, KeyLimits, Role, StoredKey, Token};
pub use leftovers::Leftover;
pub use map::{CoordinateFrame, Map, MapName, MapVocabulary, Precision, Scene};
pub use model_server::{ModelCapabilities, ModelServer, ModelTrouble};
pub use pose::{EARTH_RADIUS_M, GeographicPose, MetricPose, Pose, PoseError, PoseInput, PosePatch};
pub use secret::Secret;
pub use service_time::ServiceTime;
pub use spend::Spent;
pub use text_line::TextLine;
pub use utm::{UtmZone, UtmZoneError};
pub use verdict::{Agreement, Certainty, SamePlace};
pub use webhook::{
    Attempt, Delivery, DeliveryState, Disposition, Message, StoredWebhook, Webhook, WebhookEvent,
    WebhookSecret,
};

/// A string that cannot be parsed as the requested type; the message says why.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("{0}")]
pub struct InvalidName(pub String);
