//! What came of attempts to deliver messages.

use prometheus_client::encoding::EncodeLabelSet;

use super::Metrics;

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
pub(super) struct OutcomeLabels {
    outcome: &'static str,
}

/// What came of an attempt to deliver a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptOutcome {
    /// It was taken.
    Delivered,
    /// It is tried again.
    Failed,
    /// It is given up.
    Dead,
}

impl Metrics {
    /// Counts an attempt to deliver a message to a webhook.
    pub fn webhook_attempt(&self, outcome: AttemptOutcome) {
        let outcome = match outcome {
            AttemptOutcome::Delivered => "delivered",
            AttemptOutcome::Failed => "failed",
            AttemptOutcome::Dead => "dead",
        };
        self.webhook_attempts.get_or_create(&OutcomeLabels { outcome }).inc();
    }
}
