//! Delivers messages to webhooks in the background, at least once.
//!
//! The store is the outbox. A delivery in progress stays there until its outcome is recorded, so that one that a
//! crash interrupts is attempted again.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use tokio::task::{self, JoinSet};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::WebhookSettings;
use super::messenger::{Messenger, Reply};
use crate::{AttemptOutcome, ServiceMetrics};
use whereabouts_core::{Attempt, Delivery, Disposition, StoredWebhook};
use whereabouts_refine::mllm::random_fraction;
use whereabouts_refine::retry_for;
use whereabouts_store::{StoreError, StoredDelivery, WebhookStore};

/// Pause between two scans for due deliveries, if nothing happens.
const SCAN_PAUSE: Duration = Duration::from_secs(1);

/// Pause between two removals of old deliveries.
const CLEANUP_PAUSE: Duration = Duration::from_secs(10);

/// Maximum number of deliveries given up or removed in one transaction.
const BATCH: usize = 256;

/// How long an attempt is recorded again while the store is unavailable.
const RECORD_LIMIT: Duration = Duration::from_secs(600);

/// Pause after an attempt that could not be recorded; without it, a full disk would cause a flood of messages.
const STORE_FAILED_PAUSE: Duration = Duration::from_secs(10);

/// How long attempts in progress may take at shutdown. Aborted ones are made again after the next start.
const GRACE: Duration = Duration::from_secs(3);

const DISABLED: &str = "the webhook was disabled";

/// Delivers messages to webhooks.
pub struct Dispatcher {
    store: Arc<dyn WebhookStore>,
    messenger: Messenger,
    metrics: Arc<ServiceMetrics>,
    settings: WebhookSettings,
}

impl Dispatcher {
    /// A dispatcher without attempts in progress.
    pub fn new(
        store: Arc<dyn WebhookStore>,
        metrics: Arc<ServiceMetrics>,
        settings: WebhookSettings,
    ) -> Self {
        Self { store, messenger: Messenger::new(&settings), metrics, settings }
    }

    /// Delivers messages and removes old deliveries until `shutdown`.
    pub async fn run(self, shutdown: CancellationToken) {
        let this = Arc::new(self);
        tokio::join!(Self::deliver(&this, &shutdown), this.clean_up(&shutdown));
    }

    async fn deliver(this: &Arc<Self>, shutdown: &CancellationToken) {
        let mut queued = this.store.queued_deliveries();
        let mut in_progress = InProgress::default();
        while !shutdown.is_cancelled() {
            queued.mark_unchanged();
            if let Err(error) = Self::start_due(this, &mut in_progress).await {
                tracing::error!(%error, "due deliveries to webhooks could not be read");
            }
            tokio::select! {
                () = shutdown.cancelled() => {}
                Ok(()) = queued.changed() => {}
                Some(()) = in_progress.next() => {}
                () = tokio::time::sleep(SCAN_PAUSE) => {}
            }
        }
        let ending = async { while in_progress.next().await.is_some() {} };
        if tokio::time::timeout(GRACE, ending).await.is_err() {
            tracing::info!(
                "deliveries to webhooks were aborted; they are attempted again after the next start"
            );
        }
    }

    /// Starts due deliveries within the concurrency limits. The webhook with the fewest in progress goes first, so
    /// that a slow one does not block the others.
    async fn start_due(this: &Arc<Self>, in_progress: &mut InProgress) -> Result<(), StoreError> {
        let mut webhooks = this.store.webhooks().await?;
        webhooks.sort_by_key(|stored| in_progress.of(stored.webhook.id));
        for stored in webhooks {
            let id = stored.webhook.id;
            if stored.webhook.disabled_at.is_some() {
                this.store.give_up_deliveries(id, Timestamp::now(), DISABLED, BATCH).await?;
                continue;
            }
            let active = in_progress.of(id);
            let room = this.settings.concurrency.saturating_sub(in_progress.len());
            let room = room.min(this.settings.concurrency_each.saturating_sub(active));
            if room == 0 {
                continue;
            }
            // Deliveries in progress are still due in the store.
            let due = this.store.due_deliveries(id, Timestamp::now(), active + room).await?;
            let due = due.into_iter().filter(|due| !in_progress.has(due.delivery.id));
            let stored = Arc::new(stored);
            for due in due.take(room).collect::<Vec<_>>() {
                let (this, to) = (Arc::clone(this), Arc::clone(&stored));
                let ids = (id, due.delivery.id);
                in_progress.begin(ids, async move { this.attempt(&to, due).await });
            }
        }
        Ok(())
    }

    async fn attempt(&self, to: &StoredWebhook, due: StoredDelivery) {
        let StoredDelivery { delivery, body } = due;
        let reply = self.messenger.post(to, delivery.id, body).await;
        if let Err(error) = self.record(&delivery, reply).await {
            let Delivery { id, webhook, .. } = delivery;
            tracing::error!(%webhook, delivery = %id, %error, "an attempt could not be recorded");
            tokio::time::sleep(STORE_FAILED_PAUSE).await;
        }
    }

    async fn record(&self, delivery: &Delivery, reply: Reply) -> Result<(), StoreError> {
        let Delivery { id, webhook, event, attempts, .. } = *delivery;
        let at = Timestamp::now();
        let attempt = match reply {
            Reply::Accepted(status) => {
                let status = Some(status.as_u16());
                Attempt { at, status, error: None, disposition: Disposition::Delivered }
            }
            Reply::Gone => {
                let why = "the receiver responded 410 Gone, which asks for no more messages";
                self.store.disable_webhook(webhook, at, why).await?;
                tracing::warn!(%webhook, why, "a webhook was disabled");
                let error = Some(format!("{DISABLED}: {why}"));
                Attempt { at, status: Some(410), error, disposition: Disposition::Dead }
            }
            Reply::Failed { status, why, retry_after } => {
                let status = status.map(|status| status.as_u16());
                let disposition =
                    self.settings.after_failure(attempts, retry_after, at, random_fraction());
                Attempt { at, status, error: Some(why), disposition }
            }
        };
        let (attempts, why) = (attempts + 1, attempt.error.clone().unwrap_or_default());
        let outcome = match attempt.disposition {
            Disposition::Delivered => {
                tracing::debug!(%webhook, delivery = %id, %event, attempts, "a message was delivered");
                AttemptOutcome::Delivered
            }
            Disposition::RetryAt(next) => {
                tracing::info!(%webhook, delivery = %id, %event, attempts, why, %next, "a message was not accepted");
                AttemptOutcome::Failed
            }
            Disposition::Dead => {
                tracing::warn!(%webhook, delivery = %id, %event, attempts, why, "a message was given up");
                AttemptOutcome::Dead
            }
        };
        self.metrics.webhook_attempt(outcome);
        // Without this, a store that is busy for a moment would make the receiver get the message again.
        let note = || self.store.note_attempt(webhook, id, attempt.clone());
        retry_for(RECORD_LIMIT, note).await.map(drop)
    }

    /// Removes old deliveries until `shutdown`.
    async fn clean_up(&self, shutdown: &CancellationToken) {
        while !shutdown.is_cancelled() {
            if let Err(error) = self.remove_old(shutdown).await {
                tracing::error!(%error, "old deliveries could not be removed");
            }
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = tokio::time::sleep(CLEANUP_PAUSE) => {}
            }
        }
    }

    async fn remove_old(&self, shutdown: &CancellationToken) -> Result<(), StoreError> {
        let keep = self.settings.keep(Timestamp::now());
        let (mut ended, mut waiting) = (0, 0);
        while !shutdown.is_cancelled() {
            let removed = self.store.forget_deliveries(keep, BATCH).await?;
            ended += removed.ended;
            waiting += removed.waiting;
            if removed.ended + removed.waiting < BATCH {
                break;
            }
        }
        if waiting > 0 {
            tracing::warn!(
                waiting,
                "undelivered messages were removed, because more than webhooks.max_deliveries were \
                 waiting"
            );
        }
        if ended > 0 {
            tracing::info!(ended, "old deliveries were removed");
        }
        Ok(())
    }
}

/// Attempts in progress.
#[derive(Default)]
struct InProgress {
    tasks: JoinSet<()>,
    /// The webhook and the delivery of each.
    ids: HashMap<task::Id, (Uuid, Uuid)>,
}

impl InProgress {
    fn len(&self) -> usize {
        self.ids.len()
    }

    fn of(&self, webhook: Uuid) -> usize {
        self.ids.values().filter(|(of, _)| *of == webhook).count()
    }

    fn has(&self, delivery: Uuid) -> bool {
        self.ids.values().any(|(_, id)| *id == delivery)
    }

    fn begin(&mut self, ids: (Uuid, Uuid), attempt: impl Future<Output = ()> + Send + 'static) {
        self.ids.insert(self.tasks.spawn(attempt).id(), ids);
    }

    /// Waits until an attempt has ended; `None` if none is in progress.
    async fn next(&mut self) -> Option<()> {
        let id = match self.tasks.join_next_with_id().await? {
            Ok((id, ())) => id,
            Err(error) => {
                tracing::error!(%error, "an attempt to deliver panicked");
                error.id()
            }
        };
        self.ids.remove(&id);
        Some(())
    }
}
