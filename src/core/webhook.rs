//! Webhooks and the state of their deliveries.

use std::fmt;
use std::str::FromStr;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use jiff::Timestamp;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use utoipa::ToSchema;
use uuid::Uuid;

use super::map::display_as_written;
use super::{InvalidName, Job, JobState, MapName};

/// An event that a webhook can subscribe to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
pub enum WebhookEvent {
    /// A job finished with a ranking.
    #[serde(rename = "job.succeeded")]
    JobSucceeded,
    /// A job finished with a ranking of which a part fell back to the coarse order.
    #[serde(rename = "job.degraded")]
    JobDegraded,
    /// A job finished without a ranking.
    #[serde(rename = "job.failed")]
    JobFailed,
    /// A job was cancelled by a caller.
    #[serde(rename = "job.cancelled")]
    JobCancelled,
    /// A test message requested by the operator.
    #[serde(rename = "ping")]
    Ping,
}

display_as_written!(WebhookEvent {
    JobSucceeded => "job.succeeded",
    JobDegraded => "job.degraded",
    JobFailed => "job.failed",
    JobCancelled => "job.cancelled",
    Ping => "ping"
});

impl WebhookEvent {
    /// The events of finished jobs.
    pub const ENDS: [Self; 4] =
        [Self::JobSucceeded, Self::JobDegraded, Self::JobFailed, Self::JobCancelled];

    /// The event of a job that finished in this state; `None` if the state is not final.
    pub fn of(state: JobState) -> Option<Self> {
        match state {
            JobState::Queued | JobState::Running => None,
            JobState::Succeeded => Some(Self::JobSucceeded),
            JobState::Degraded => Some(Self::JobDegraded),
            JobState::Failed => Some(Self::JobFailed),
            JobState::Cancelled => Some(Self::JobCancelled),
        }
    }
}

/// A webhook without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Webhook {
    /// Id of the webhook. Ids sort by creation time.
    pub id: Uuid,
    /// URL to which messages are posted.
    pub url: String,
    /// Events that the webhook receives.
    pub events: Vec<WebhookEvent>,
    /// Restricts the events to jobs of this map; null for all maps.
    #[schema(nullable)]
    pub map: Option<MapName>,
    /// When the webhook was created. It receives no earlier events.
    pub created_at: Timestamp,
    /// When the webhook was disabled; null if it is enabled.
    #[schema(nullable)]
    pub disabled_at: Option<Timestamp>,
    /// Why the webhook was disabled.
    #[schema(nullable)]
    pub disabled_reason: Option<String>,
}

impl Webhook {
    /// Whether the webhook receives this event of a job.
    pub fn subscribes_to(&self, event: WebhookEvent, job: &Job) -> bool {
        self.disabled_at.is_none()
            && self.events.contains(&event)
            && self.map.as_ref().is_none_or(|map| *map == job.map)
    }
}

/// A webhook as stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoredWebhook {
    /// The webhook.
    #[serde(flatten)]
    pub webhook: Webhook,
    /// Key that signs the messages. Stored in plain text, because signing needs it.
    pub secret: WebhookSecret,
}

/// The signing secret shared with the receiver of a webhook. It serializes in plain text, for the store and
/// for the one answer that shows it; `Debug` hides it.
#[derive(Clone, PartialEq, Eq)]
pub struct WebhookSecret(Vec<u8>);

impl WebhookSecret {
    /// Prefix of every secret.
    pub const PREFIX: &str = "whsec_";

    /// Builds a secret from random bytes.
    pub fn new(random: &[u8; 32]) -> Self {
        Self(random.to_vec())
    }

    /// The bytes of the signing key.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// The secret in plain text: `whsec_` and the bytes in base64.
    pub fn reveal(&self) -> String {
        format!("{}{}", Self::PREFIX, STANDARD.encode(&self.0))
    }
}

impl FromStr for WebhookSecret {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        let bytes = text.strip_prefix(Self::PREFIX).and_then(|text| STANDARD.decode(text).ok());
        let invalid =
            || InvalidName("a webhook's secret is \"whsec_\" and base64 of 24 to 64 bytes".into());
        bytes.filter(|bytes| (24..=64).contains(&bytes.len())).map(Self).ok_or_else(invalid)
    }
}

impl fmt::Debug for WebhookSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}…", Self::PREFIX)
    }
}

impl Serialize for WebhookSecret {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.reveal())
    }
}

impl<'de> Deserialize<'de> for WebhookSecret {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}

/// The state of a delivery.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum DeliveryState {
    /// Waiting for its first or next attempt.
    Waiting,
    /// Accepted by the receiver.
    Delivered,
    /// Given up. Kept for a while, and can be redelivered.
    Dead,
}

display_as_written!(DeliveryState { Waiting => "waiting", Delivered => "delivered", Dead => "dead" });

/// The delivery of one message to one webhook.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Delivery {
    /// Id of the delivery, sent as `webhook-id` in every attempt. Ids sort by creation time.
    pub id: Uuid,
    /// Id of the webhook.
    pub webhook: Uuid,
    /// Event that is reported.
    pub event: WebhookEvent,
    /// Id of the job, if the event is about one.
    #[schema(nullable)]
    pub job: Option<Uuid>,
    /// State of the delivery.
    pub state: DeliveryState,
    /// When the delivery was first queued.
    pub created_at: Timestamp,
    /// Attempts since the delivery was last queued.
    pub attempts: u32,
    /// Time of the last attempt.
    #[schema(nullable)]
    pub last_attempt_at: Option<Timestamp>,
    /// HTTP status of the last attempt, if the receiver answered.
    #[schema(nullable)]
    pub last_status: Option<u16>,
    /// Error of the last attempt, or why the delivery was given up.
    #[schema(nullable)]
    pub last_error: Option<String>,
    /// Time of the next attempt; null unless the delivery is waiting.
    #[schema(nullable)]
    pub next_attempt_at: Option<Timestamp>,
    /// When the message was delivered or given up; null while it is waiting.
    #[schema(nullable)]
    pub ended_at: Option<Timestamp>,
}

/// The result of one delivery attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attempt {
    /// When the attempt ended.
    pub at: Timestamp,
    /// HTTP status, if the receiver answered.
    pub status: Option<u16>,
    /// Why the attempt failed.
    pub error: Option<String>,
    /// What happens to the delivery next.
    pub disposition: Disposition,
}

/// What happens to a delivery after an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disposition {
    /// The message was delivered.
    Delivered,
    /// The next attempt is made at this time.
    RetryAt(Timestamp),
    /// The delivery is given up.
    Dead,
}

impl Delivery {
    /// Creates a delivery that is due at once.
    pub fn queued(webhook: Uuid, event: WebhookEvent, job: Option<Uuid>, now: Timestamp) -> Self {
        Self {
            id: Uuid::now_v7(),
            webhook,
            event,
            job,
            state: DeliveryState::Waiting,
            created_at: now,
            attempts: 0,
            last_attempt_at: None,
            last_status: None,
            last_error: None,
            next_attempt_at: Some(now),
            ended_at: None,
        }
    }

    /// Queues the delivery again under the same id, without its earlier attempts.
    pub fn requeued(self, now: Timestamp) -> Self {
        let Self { id, webhook, event, job, created_at, .. } = self;
        Self { id, created_at, ..Self::queued(webhook, event, job, now) }
    }

    /// Applies the result of an attempt.
    pub fn with_attempt(self, attempt: Attempt) -> Self {
        let Attempt { at, status, error, disposition } = attempt;
        let (state, next_attempt_at, ended_at) = match disposition {
            Disposition::Delivered => (DeliveryState::Delivered, None, Some(at)),
            Disposition::RetryAt(next) => (DeliveryState::Waiting, Some(next), None),
            Disposition::Dead => (DeliveryState::Dead, None, Some(at)),
        };
        Self {
            state,
            attempts: self.attempts.saturating_add(1),
            last_attempt_at: Some(at),
            last_status: status,
            last_error: error,
            next_attempt_at,
            ended_at,
            ..self
        }
    }

    /// Gives the delivery up without another attempt.
    pub fn dead_lettered(self, at: Timestamp, why: &str) -> Self {
        Self {
            state: DeliveryState::Dead,
            last_error: Some(why.to_owned()),
            next_attempt_at: None,
            ended_at: Some(at),
            ..self
        }
    }
}

/// The JSON body posted to a webhook.
#[derive(Debug, Serialize)]
pub struct Message<'a, T> {
    /// Event that is reported.
    #[serde(rename = "type")]
    pub event: WebhookEvent,
    /// Time of the event.
    pub timestamp: Timestamp,
    /// The subject of the event: a job, or nothing for a ping.
    pub data: &'a T,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_serializes_in_full_and_is_hidden_from_debug() {
        let secret = WebhookSecret::new(&[7; 32]);
        let text = secret.reveal();
        assert_eq!(text, format!("whsec_{}", STANDARD.encode([7; 32])));
        assert_eq!(text.parse(), Ok(secret.clone()));
        assert_eq!(format!("{secret:?}"), "whsec_…");
        for wrong in ["", "whsec_", "whsec_c2hvcnQ=", "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "whsec_!"]
        {
            let error = wrong.parse::<WebhookSecret>().unwrap_err();
            assert!(!error.to_string().contains("MfKQ"));
        }
    }

    #[test]
    fn every_final_job_state_has_an_event_of_the_same_name() {
        for (state, event) in [
            (JobState::Succeeded, WebhookEvent::JobSucceeded),
            (JobState::Degraded, WebhookEvent::JobDegraded),
            (JobState::Failed, WebhookEvent::JobFailed),
            (JobState::Cancelled, WebhookEvent::JobCancelled),
        ] {
            assert_eq!(WebhookEvent::of(state), Some(event));
            assert!(WebhookEvent::ENDS.contains(&event));
            assert_eq!(event.to_string(), format!("job.{state}"));
            assert_eq!(serde_json::to_value(event).unwrap(), event.as_str());
        }
        assert_eq!(WebhookEvent::of(JobState::Running), None);
    }

    #[test]
    fn a_requeued_delivery_keeps_its_id_and_drops_its_attempts() {
        let now = Timestamp::now();
        let first = Delivery::queued(Uuid::now_v7(), WebhookEvent::Ping, None, now);
        let attempt = Attempt {
            at: now,
            status: Some(500),
            error: Some("500".into()),
            disposition: Disposition::Dead,
        };
        let dead = first.clone().with_attempt(attempt);
        assert_eq!((dead.state, dead.attempts), (DeliveryState::Dead, 1));
        assert_eq!(dead.requeued(now), first);
    }
}
