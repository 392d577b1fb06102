//! What is known about the servers of multimodal models.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A server of multimodal models, as the refiner knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelServer {
    /// Base URL, without credentials.
    pub url: String,
    /// Models that the refiner uses there.
    pub models: Vec<String>,
    /// Whether calls are suspended because the last ones failed.
    pub suspended: bool,
    /// Seconds until the next call is tried; null while calls are not suspended.
    #[schema(nullable)]
    pub suspended_for_s: Option<f64>,
    /// The last failure since a call succeeded, or why answers cannot be used; null if there is neither.
    #[schema(nullable)]
    pub trouble: Option<ModelTrouble>,
    /// What the server can do.
    pub capabilities: ModelCapabilities,
}

/// A failed call to a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelTrouble {
    /// When the call failed.
    pub at: Timestamp,
    /// Kind of the failure, such as `key`, `quota`, `not_found`, `timeout` or `connection_refused`; `no_answer` if the
    /// model answers, but refuses or says nothing that can be used.
    pub kind: String,
    /// HTTP status; null if there was no response.
    #[schema(nullable)]
    pub status: Option<u16>,
    /// The cause, in the server's words where it has any.
    pub message: String,
}

/// What a server of multimodal models can do, as far as it is known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelCapabilities {
    /// When the server was last checked; null if it has not been.
    #[schema(nullable)]
    pub checked_at: Option<Timestamp>,
    /// Whether it takes two pictures in a request; null if that is not known.
    #[schema(nullable)]
    pub two_pictures: Option<bool>,
    /// How it is asked for the format of an answer: `bounded_schema`, `schema`, `json_object` or `text`.
    pub answer_format: String,
    /// Whether it is sent a temperature.
    pub temperature: bool,
    /// Name of the field that bounds the length of an answer; null if it accepts neither name.
    #[schema(nullable)]
    pub max_tokens_field: Option<String>,
    /// Longest answer that it lets a request ask for, in tokens; null if that is not known.
    #[schema(nullable)]
    pub answer_tokens: Option<u32>,
    /// Whether it is sent a system message.
    pub system_message: bool,
    /// Length of its context, in tokens; null if that is not known.
    #[schema(nullable)]
    pub context_tokens: Option<u64>,
    /// Calls that are made at once at most, at the moment.
    pub calls_at_once: usize,
}
