//! One attempt at a call: its permit, its admission, and what its outcome says about the server.

use std::pin::pin;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tracing::Instrument;
use whereabouts_telemetry::traces;

use super::client::{Answer, Call, MllmClient};
use super::failure::FailureKind;
use super::gate::{CallPlace, Permit};
use super::limit::CallPurpose;
use super::retry::AttemptError;

/// How long calls wait for the first one of all, whose failure may tell that the others are in vain.
const SCOUT_WAIT: Duration = Duration::from_millis(500);

impl MllmClient {
    /// Makes one attempt at a call, with the permit that it has or when it gets one.
    pub(super) async fn attempt(
        &self,
        call: &Call<'_>,
        place: CallPlace,
        permit: Option<Permit>,
    ) -> Result<Answer, AttemptError> {
        let mut permit = match permit {
            Some(permit) => permit,
            None => self.gate.pass(place).await,
        };
        let _scout = self.scouting().await;
        let admission = self
            .breaker
            .admit()
            .await
            .map_err(|open| AttemptError::Open { wait: open.wait, cause: self.last_trouble() })?;
        let most = call.prompt_tokens + u64::from(call.max_tokens);
        self.rate.take(most).await;
        let (purpose, name) = match call.labels {
            Some(_) => (CallPurpose::Rank, "reason"),
            None => (CallPurpose::Describe, "describe"),
        };
        let span = traces::model_call(call.model, name);
        let patience = permit.sent(purpose).unwrap_or(Duration::MAX);
        let mut exchange = pin!(self.exchange(call).instrument(span.clone()));
        let outcome = match tokio::time::timeout(patience, &mut exchange).await {
            Ok(outcome) => outcome,
            Err(_) => {
                permit.is_late();
                exchange.await
            }
        };
        let tokens = outcome.as_ref().map(|a| (a.prompt_tokens, a.completion_tokens));
        traces::model_answered(&span, tokens.map_err(|failure| failure.why.clone()));
        match outcome {
            Ok(answer) => {
                permit.answered(answer.took);
                admission.succeeded();
                self.is_proven.store(true, Ordering::Relaxed);
                *self.trouble.lock() = None;
                self.rate.settle(most, answer.prompt_tokens + answer.completion_tokens).await;
                Ok(answer)
            }
            Err(failure) => {
                if failure.turned_away {
                    let longest = self.retry.longest_retry_after;
                    let asked = failure.retry_after.filter(|asked| *asked <= longest);
                    let answers =
                        !matches!(failure.kind, FailureKind::Refused | FailureKind::Connection);
                    if permit.turned_away(asked, answers) {
                        tracing::debug!(why = failure.why, "the MLLM server turned a call away");
                        self.remember(&failure);
                        return Err(AttemptError::Crowded(failure));
                    }
                } else if failure.kind == FailureKind::Timeout {
                    permit.timed_out(self.timeout);
                }
                let stopped = match failure.kind {
                    kind if kind.stops_all() => {
                        self.is_proven.store(false, Ordering::Relaxed);
                        Some(admission.refused())
                    }
                    // A server that turns the only call away takes none at the moment.
                    kind if kind.is_the_servers() || failure.turned_away => {
                        admission.failed();
                        None
                    }
                    _ => {
                        admission.succeeded();
                        None
                    }
                };
                self.note(&failure);
                Err(AttemptError::Failed(failure, stopped))
            }
        }
    }

    /// Until the server has answered once, one call goes ahead of the others, for a moment at most.
    async fn scouting(&self) -> Option<tokio::sync::MutexGuard<'_, ()>> {
        let is_proven = || self.is_proven.load(Ordering::Relaxed);
        if is_proven() {
            return None;
        }
        let guard = tokio::time::timeout(SCOUT_WAIT, self.scout.lock()).await.ok();
        guard.filter(|_| !is_proven())
    }
}
