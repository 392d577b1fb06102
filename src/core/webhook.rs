//! Webhooks: who is told when a job ends, and what became of telling them.

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

/// What a webhook is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
pub enum WebhookEvent {
    /// A job ended with a ranking.
    #[serde(rename = "job.succeeded")]
    JobSucceeded,
    /// A job ended with a ranking of which part fell back to the coarse order.
    #[serde(rename = "job.degraded")]
    JobDegraded,
    /// A job ended without a ranking.
    #[serde(rename = "job.failed")]
    JobFailed,
    /// A job ended because a caller asked for it.
    #[serde(rename = "job.cancelled")]
    JobCancelled,
    /// Somebody tries the webhook out.
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
    /// All ends of jobs.
    pub const ENDS: [Self; 4] =
        [Self::JobSucceeded, Self::JobDegraded, Self::JobFailed, Self::JobCancelled];

    /// The end of a job that is in this state; none, if it has not ended.
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

/// A webhook, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Webhook {
    /// Its id; ids of later webhooks sort after those of earlier ones.
    pub id: Uuid,
    /// Where messages are posted.
    pub url: String,
    /// What it is told.
    pub events: Vec<WebhookEvent>,
    /// Only of jobs of this map; null for all.
    #[schema(nullable)]
    pub map: Option<MapName>,
    /// When it was made. It is told nothing that happened before.
    pub created_at: Timestamp,
    /// Since when it is told nothing any more; null if it is.
    #[schema(nullable)]
    pub disabled_at: Option<Timestamp>,
    /// Why that is.
    #[schema(nullable)]
    pub disabled_reason: Option<String>,
}

impl Webhook {
    /// Whether it is to be told of this event of a job.
    pub fn subscribes_to(&self, event: WebhookEvent, job: &Job) -> bool {
        self.disabled_at.is_none()
            && self.events.contains(&event)
            && self.map.as_ref().is_none_or(|map| *map == job.map)
    }
}

/// A webhook as it is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoredWebhook {
    /// The webhook.
    #[serde(flatten)]
    pub webhook: Webhook,
    /// What its messages are signed with. It is stored as it is, because signing takes all of it.
    pub secret: WebhookSecret,
}

/// What both ends of a webhook know. It is written out where it is stored and where it is shown once; it
/// shows itself in no log and no error.
#[derive(Clone, PartialEq, Eq)]
pub struct WebhookSecret(Vec<u8>);

impl WebhookSecret {
    /// What every secret begins with.
    pub const PREFIX: &str = "whsec_";

    /// The secret of these random bytes.
    pub fn new(random: &[u8; 32]) -> Self {
        Self(random.to_vec())
    }

    /// The bytes that sign.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }

    /// The secret as its holder gets it: `whsec_` and the bytes in base64.
    pub fn reveal(&self) -> String {
        format!("{}{}", Self::PREFIX, STANDARD.encode(&self.0))
    }
}

impl FromStr for WebhookSecret {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        let bytes = text.strip_prefix(Self::PREFIX).and_then(|text| STANDARD.decode(text).ok());
        let is_no_secret =
            || InvalidName("a webhook's secret is \"whsec_\" and base64 of 24 to 64 bytes".into());
        bytes.filter(|bytes| (24..=64).contains(&bytes.len())).map(Self).ok_or_else(is_no_secret)
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

/// How far a delivery has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum DeliveryState {
    /// It is tried, or will be tried again.
    Waiting,
    /// The other end took it.
    Delivered,
    /// It was given up. It is kept for a while, and can be delivered again.
    Dead,
}

display_as_written!(DeliveryState { Waiting => "waiting", Delivered => "delivered", Dead => "dead" });

/// One message for one webhook.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Delivery {
    /// Its id, `webhook-id` of the message, in every attempt; ids of later ones sort after those of earlier
    /// ones.
    pub id: Uuid,
    /// The webhook.
    pub webhook: Uuid,
    /// What happened.
    pub event: WebhookEvent,
    /// The job to which it happened, if it is about one.
    #[schema(nullable)]
    pub job: Option<Uuid>,
    /// How far it has come.
    pub state: DeliveryState,
    /// When it was queued first.
    pub created_at: Timestamp,
    /// How often it was tried since it was last queued.
    pub attempts: u32,
    /// When that was last.
    #[schema(nullable)]
    pub last_attempt_at: Option<Timestamp>,
    /// The HTTP status that the other end gave then, if it answered.
    #[schema(nullable)]
    pub last_status: Option<u16>,
    /// What went wrong then, or why it is dead.
    #[schema(nullable)]
    pub last_error: Option<String>,
    /// When it is tried next; null unless it waits.
    #[schema(nullable)]
    pub next_attempt_at: Option<Timestamp>,
    /// When it was delivered or given up; null while it waits.
    #[schema(nullable)]
    pub ended_at: Option<Timestamp>,
}

/// How one attempt went.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attempt {
    /// When it ended.
    pub at: Timestamp,
    /// The HTTP status, if there was an answer.
    pub status: Option<u16>,
    /// What went wrong.
    pub error: Option<String>,
    /// What becomes of the delivery.
    pub disposition: Disposition,
}

/// What becomes of a delivery after an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disposition {
    /// It is delivered.
    Delivered,
    /// It is tried again at this moment.
    RetryAt(Timestamp),
    /// It is given up.
    Dead,
}

impl Delivery {
    /// A new one, to be tried at once.
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

    /// Queues it anew, as if it had never been tried.
    pub fn requeued(self, now: Timestamp) -> Self {
        let Self { id, webhook, event, job, created_at, .. } = self;
        Self { id, created_at, ..Self::queued(webhook, event, job, now) }
    }

    /// The same after an attempt.
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

    /// The same, given up without another attempt.
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

/// What is posted.
#[derive(Debug, Serialize)]
pub struct Message<'a, T> {
    /// What happened.
    #[serde(rename = "type")]
    pub event: WebhookEvent,
    /// When.
    pub timestamp: Timestamp,
    /// To what.
    pub data: &'a T,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_is_written_whole_for_its_holder_and_not_at_all_for_a_log() {
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
    fn every_end_of_a_job_is_an_event_of_that_name() {
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
    fn a_delivery_that_is_queued_anew_keeps_its_id_and_forgets_its_attempts() {
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
