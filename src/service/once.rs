//! Requests that are done once, however often they are sent.

use std::time::Duration;

use jiff::Timestamp;

use super::retention::before;
use super::{Service, ServiceError};
use whereabouts_core::Digest;
use whereabouts_store::{IdempotencyRecord, Progress, StoredResponse};

/// What answers to requests with a key are kept for.
#[derive(Debug, Clone, Copy)]
pub struct IdempotencySettings {
    /// How long.
    pub keep: Duration,
    /// How many.
    pub most: usize,
}

impl IdempotencySettings {
    /// Answers from before this moment count no more.
    pub fn since(&self, now: Timestamp) -> Timestamp {
        before(now, self.keep)
    }
}

/// What is to be done with a request that has a key.
#[derive(Debug, Clone, PartialEq)]
pub enum Once {
    /// It is the first: do it, and then say so with [`Service::end_once`].
    First,
    /// It was done: this was the answer.
    Again(StoredResponse),
    /// It is being done.
    Running,
    /// The key was another request's.
    Other,
}

impl Service {
    /// Takes up a request by the id that its sender gave it.
    pub async fn begin_once(&self, id: &str, fingerprint: Digest) -> Result<Once, ServiceError> {
        let now = Timestamp::now();
        let settings = self.settings.once;
        let progress = Progress::Running { process: self.process, job: None };
        let reserved = IdempotencyRecord { fingerprint, at: now, progress };
        Ok(match self.answers.reserve_request(id, reserved, settings.since(now)).await? {
            None => Once::First,
            Some(known) if known.fingerprint != fingerprint => Once::Other,
            Some(IdempotencyRecord { progress: Progress::Answered(kept), .. }) => Once::Again(kept),
            Some(IdempotencyRecord { progress: Progress::Running { .. }, .. }) => Once::Running,
        })
    }

    /// The request was done: `kept` is what is answered when it comes again; `None`, if it is to be done
    /// anew then.
    pub async fn end_once(
        &self,
        id: &str,
        fingerprint: Digest,
        kept: Option<StoredResponse>,
    ) -> Result<(), ServiceError> {
        match kept {
            None => self.answers.forget_request(id).await?,
            Some(kept) => {
                let progress = Progress::Answered(kept);
                let answer = IdempotencyRecord { fingerprint, at: Timestamp::now(), progress };
                self.answers.store_response(id, answer).await?;
            }
        }
        Ok(())
    }
}
