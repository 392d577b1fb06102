//! Idempotency keys: a request that is sent again is not processed again; its first response is replayed.
//!
//! Which responses are worth replaying is for the caller to decide.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::ServiceError;
use super::retention::before;
use whereabouts_core::Digest;
use whereabouts_core::units::hours;
use whereabouts_store::{IdempotencyRecord, IdempotencyStore, Progress, StoredResponse};

/// `[idempotency]`
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IdempotencySettings {
    /// How long a response is kept.
    #[serde(rename = "keep_hours", with = "hours")]
    pub keep: Duration,
    /// The maximum number of responses.
    #[serde(rename = "max")]
    pub most: usize,
}

impl IdempotencySettings {
    /// Responses stored before this time have expired.
    pub fn since(&self, now: Timestamp) -> Timestamp {
        before(now, self.keep)
    }
}

/// What to do with a request that has an idempotency key.
#[derive(Debug, Clone, PartialEq)]
pub enum IdempotencyOutcome {
    /// It is new: process it, and then call [`Idempotency::end`].
    First,
    /// It was processed before: replay this response.
    Replay(StoredResponse),
    /// It is being processed.
    InProgress,
    /// The key was used for a different request.
    KeyReused,
}

/// Requests with an `Idempotency-Key`, each of which is processed once.
pub struct Idempotency {
    /// Reservations and stored responses.
    pub store: Arc<dyn IdempotencyStore>,
    /// This process; the reservation of a process that died is taken over.
    pub process: Uuid,
    /// How long and how many responses are kept.
    pub settings: IdempotencySettings,
}

impl Idempotency {
    /// Reserves a request by its idempotency key. `fingerprint` tells it from other requests with the same key.
    pub async fn begin(
        &self,
        id: &str,
        fingerprint: Digest,
    ) -> Result<IdempotencyOutcome, ServiceError> {
        let now = Timestamp::now();
        let settings = self.settings;
        let progress = Progress::Running { process: self.process, job: None };
        let reserved = IdempotencyRecord { fingerprint, at: now, progress };
        Ok(match self.store.reserve_request(id, reserved, settings.since(now)).await? {
            None => IdempotencyOutcome::First,
            Some(known) if known.fingerprint != fingerprint => IdempotencyOutcome::KeyReused,
            Some(IdempotencyRecord { progress: Progress::Answered(response), .. }) => {
                IdempotencyOutcome::Replay(response)
            }
            Some(IdempotencyRecord { progress: Progress::Running { .. }, .. }) => {
                IdempotencyOutcome::InProgress
            }
        })
    }

    /// Ends the reservation of a request. `response` is replayed when the request is sent again; without one
    /// it is then processed again.
    pub async fn end(
        &self,
        id: &str,
        fingerprint: Digest,
        response: Option<StoredResponse>,
    ) -> Result<(), ServiceError> {
        match response {
            None => self.store.forget_request(id).await?,
            Some(response) => {
                let progress = Progress::Answered(response);
                let record = IdempotencyRecord { fingerprint, at: Timestamp::now(), progress };
                self.store.store_response(id, record).await?;
            }
        }
        Ok(())
    }
}
