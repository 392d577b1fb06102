//! Brings deliveries to their webhooks, in the background.
//!
//! What waits is in the store. A delivery in progress stays there as it was until its end is noted, so that
//! one that a crash interrupts is tried again: it comes at least once.

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
use whereabouts_store::{StoreError, StoredDelivery, WebhookStore};

/// The pause between two looks at what is due, if nothing happens.
const PAUSE: Duration = Duration::from_secs(1);

/// The pause between two looks at what has had its time.
const TIDY_PAUSE: Duration = Duration::from_secs(10);

/// The most deliveries given up or removed in one change.
const BATCH: usize = 256;

/// After an attempt that cannot be noted; without it, a full disk would make a flood of messages.
const STORE_FAILED_PAUSE: Duration = Duration::from_secs(10);

/// How long attempts in progress may take to end when the server does. They are tried again after the start.
const GRACE: Duration = Duration::from_secs(3);

const DISABLED: &str = "the webhook was disabled";

/// Brings deliveries to their webhooks.
pub struct Dispatcher {
    store: Arc<dyn WebhookStore>,
    messenger: Messenger,
    metrics: Arc<ServiceMetrics>,
    settings: WebhookSettings,
}

impl Dispatcher {
    /// One that has nothing in progress.
    pub fn new(
        store: Arc<dyn WebhookStore>,
        metrics: Arc<ServiceMetrics>,
        settings: WebhookSettings,
    ) -> Self {
        Self { store, messenger: Messenger::new(&settings), metrics, settings }
    }

    /// Works until `shutdown`.
    pub async fn run(self, shutdown: CancellationToken) {
        let this = Arc::new(self);
        tokio::join!(Self::deliver(&this, &shutdown), this.tidy(&shutdown));
    }

    async fn deliver(this: &Arc<Self>, shutdown: &CancellationToken) {
        let mut queued = this.store.queued_deliveries();
        let mut in_progress = InProgress::default();
        while !shutdown.is_cancelled() {
            queued.mark_unchanged();
            if let Err(error) = Self::look(this, &mut in_progress).await {
                tracing::error!(%error, "deliveries to webhooks cannot be looked at");
            }
            tokio::select! {
                () = shutdown.cancelled() => {}
                Ok(()) = queued.changed() => {}
                Some(()) = in_progress.next() => {}
                () = tokio::time::sleep(PAUSE) => {}
            }
        }
        let ending = async { while in_progress.next().await.is_some() {} };
        if tokio::time::timeout(GRACE, ending).await.is_err() {
            tracing::info!(
                "messages to webhooks were broken off; they are tried again after the start"
            );
        }
    }

    /// Begins what is due, as far as there is room. Who has least in progress goes first, so that one that
    /// is slow holds up no other.
    async fn look(this: &Arc<Self>, in_progress: &mut InProgress) -> Result<(), StoreError> {
        let mut webhooks = this.store.webhooks().await?;
        webhooks.sort_by_key(|stored| in_progress.of(stored.webhook.id));
        for stored in webhooks {
            let id = stored.webhook.id;
            if stored.webhook.disabled_at.is_some() {
                this.store.give_up_deliveries(id, Timestamp::now(), DISABLED, BATCH).await?;
                continue;
            }
            let held = in_progress.of(id);
            let room = this.settings.concurrency.saturating_sub(in_progress.len());
            let room = room.min(this.settings.concurrency_each.saturating_sub(held));
            if room == 0 {
                continue;
            }
            // What is in progress is among what is due.
            let due = this.store.due_deliveries(id, Timestamp::now(), held + room).await?;
            let due = due.into_iter().filter(|due| !in_progress.has(due.delivery.id));
            let stored = Arc::new(stored);
            for due in due.take(room).collect::<Vec<_>>() {
                let (this, to) = (Arc::clone(this), Arc::clone(&stored));
                let what = (id, due.delivery.id);
                in_progress.begin(what, async move { this.attempt(&to, due).await });
            }
        }
        Ok(())
    }

    async fn attempt(&self, to: &StoredWebhook, due: StoredDelivery) {
        let StoredDelivery { delivery, body } = due;
        let reply = self.messenger.post(to, delivery.id, body).await;
        if let Err(error) = self.note(&delivery, reply).await {
            let Delivery { id, webhook, .. } = delivery;
            tracing::error!(%webhook, delivery = %id, %error, "an attempt cannot be noted");
            tokio::time::sleep(STORE_FAILED_PAUSE).await;
        }
    }

    async fn note(&self, delivery: &Delivery, reply: Reply) -> Result<(), StoreError> {
        let Delivery { id, webhook, event, attempts, .. } = *delivery;
        let at = Timestamp::now();
        let attempt = match reply {
            Reply::Taken(status) => {
                let status = Some(status.as_u16());
                Attempt { at, status, error: None, disposition: Disposition::Delivered }
            }
            Reply::Gone => {
                let why = "the answer was 410 Gone, which asks for no more messages";
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
        let (tried, why) = (attempts + 1, attempt.error.clone().unwrap_or_default());
        let outcome = match attempt.disposition {
            Disposition::Delivered => {
                tracing::debug!(%webhook, delivery = %id, %event, tried, "a message was delivered");
                AttemptOutcome::Delivered
            }
            Disposition::RetryAt(next) => {
                tracing::info!(%webhook, delivery = %id, %event, tried, why, %next, "a message was not taken");
                AttemptOutcome::Failed
            }
            Disposition::Dead => {
                tracing::warn!(%webhook, delivery = %id, %event, tried, why, "a message was given up");
                AttemptOutcome::Dead
            }
        };
        self.metrics.webhook_attempt(outcome);
        self.store.note_attempt(webhook, id, attempt).await.map(drop)
    }

    /// Removes deliveries that have had their time.
    async fn tidy(&self, shutdown: &CancellationToken) {
        while !shutdown.is_cancelled() {
            if let Err(error) = self.forget(shutdown).await {
                tracing::error!(%error, "old deliveries cannot be removed");
            }
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = tokio::time::sleep(TIDY_PAUSE) => {}
            }
        }
    }

    async fn forget(&self, shutdown: &CancellationToken) -> Result<(), StoreError> {
        let keep = self.settings.keep(Timestamp::now());
        let (mut ended, mut waiting) = (0, 0);
        while !shutdown.is_cancelled() {
            let forgotten = self.store.forget_deliveries(keep, BATCH).await?;
            ended += forgotten.ended;
            waiting += forgotten.waiting;
            if forgotten.ended + forgotten.waiting < BATCH {
                break;
            }
        }
        if waiting > 0 {
            tracing::warn!(
                waiting,
                "messages that were never delivered were removed, because more than \
                 webhooks.max_deliveries wait"
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
    what: HashMap<task::Id, (Uuid, Uuid)>,
}

impl InProgress {
    fn len(&self) -> usize {
        self.what.len()
    }

    fn of(&self, webhook: Uuid) -> usize {
        self.what.values().filter(|(of, _)| *of == webhook).count()
    }

    fn has(&self, delivery: Uuid) -> bool {
        self.what.values().any(|(_, id)| *id == delivery)
    }

    fn begin(&mut self, what: (Uuid, Uuid), attempt: impl Future<Output = ()> + Send + 'static) {
        self.what.insert(self.tasks.spawn(attempt).id(), what);
    }

    /// Waits until one has ended; `None` if there is none.
    async fn next(&mut self) -> Option<()> {
        let id = match self.tasks.join_next_with_id().await? {
            Ok((id, ())) => id,
            Err(error) => {
                tracing::error!(%error, "an attempt to deliver broke off");
                error.id()
            }
        };
        self.what.remove(&id);
        Some(())
    }
}
