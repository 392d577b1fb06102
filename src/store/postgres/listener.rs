//! Receives notifications of changes by other processes (`LISTEN`).
//!
//! Notifications are lost while the connection is down. After a reconnect, the jobs that changed
//! meanwhile are published again.

use std::sync::Weak;
use std::time::{Duration, Instant};

use sqlx::PgPool;
use sqlx::postgres::{PgConnectOptions, PgListener, PgNotification, PgPoolOptions};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::super::StoreError;
use super::Inner;

/// Channel: a job changed; the payload is its id.
pub(super) const JOBS: &str = "whereabouts_jobs";
/// Channel: deliveries to webhooks were queued.
pub(super) const DELIVERIES: &str = "whereabouts_deliveries";
/// Channel: an API key was created or revoked.
pub(super) const KEYS: &str = "whereabouts_keys";

/// The pause before reconnecting.
const RECONNECT_PAUSE: Duration = Duration::from_millis(250);

/// Maximum number of jobs published again after a reconnect.
const MAX_REPUBLISHED: i64 = 1000;

/// Opens a connection that listens. It has a pool of its own, because a dead connection would occupy a
/// place in the shared pool for a long time.
pub(super) async fn connect(pool: &PgPool) -> Result<PgListener, StoreError> {
    let own = PgPoolOptions::new()
        .max_connections(1)
        .connect_lazy_with(PgConnectOptions::clone(&pool.connect_options()));
    let mut listener = PgListener::connect_with(&own).await?;
    listener.ignore_pool_close_event(true);
    listener.eager_reconnect(false);
    listener.listen_all([JOBS, DELIVERIES, KEYS]).await?;
    Ok(listener)
}

/// Listens until the store is closed.
pub(super) async fn listen(first: PgListener, store: Weak<Inner>, closed: CancellationToken) {
    let (mut first, mut connected_at) = (Some(first), Instant::now());
    loop {
        let lost = tokio::select! {
            () = closed.cancelled() => return,
            lost = receive(first.take(), &store, &mut connected_at) => lost,
        };
        if store.strong_count() == 0 {
            return;
        }
        if let Err(error) = lost {
            tracing::warn!(%error, "notifications of other processes' changes are lost; reconnecting");
        }
        tokio::select! {
            () = closed.cancelled() => return,
            () = tokio::time::sleep(RECONNECT_PAUSE) => {}
        }
    }
}

/// Receives notifications until the connection is lost, and records when it was last known to work.
async fn receive(
    connected: Option<PgListener>,
    store: &Weak<Inner>,
    connected_at: &mut Instant,
) -> Result<(), StoreError> {
    let Some(inner) = store.upgrade() else { return Ok(()) };
    let timeout = inner.settings.timeout;
    let mut listener = match connected {
        Some(listener) => listener,
        None => {
            let listener = inner.call(connect(&inner.pool)).await?;
            inner.call(inner.republish(connected_at.elapsed())).await?;
            listener
        }
    };
    drop(inner);
    loop {
        *connected_at = Instant::now();
        let notification = tokio::time::timeout(timeout, listener.try_recv()).await;
        let Some(inner) = store.upgrade() else { return Ok(()) };
        match notification {
            Ok(notification) => {
                let lost = || super::unavailable("the connection was lost");
                inner.publish(&notification?.ok_or_else(lost)?);
            }
            // Nothing has changed, or the connection is dead.
            Err(_) => {
                let ping = sqlx::query("SELECT 1").execute(&mut listener);
                inner.call(async { Ok(ping.await?) }).await?;
            }
        }
    }
}

impl Inner {
    /// Passes a notification on to the receivers in this process.
    fn publish(&self, notification: &PgNotification) {
        match notification.channel() {
            JOBS => {
                if let Ok(id) = notification.payload().parse::<Uuid>() {
                    let _ = self.changes.send(id);
                }
            }
            DELIVERIES => {
                self.deliveries.send_replace(());
            }
            KEYS => {
                self.keys.send_replace(());
            }
            _ => {}
        }
    }

    /// Publishes whatever may have changed while the connection was down.
    async fn republish(&self, outage: Duration) -> Result<(), StoreError> {
        self.deliveries.send_replace(());
        self.keys.send_replace(());
        // A generous margin costs little; the database itself may have been down for part of the time.
        let since = outage.as_secs_f64() + 2.0 * self.settings.timeout.as_secs_f64();
        let changed: Vec<Uuid> = sqlx::query_scalar(
            "SELECT id FROM jobs WHERE changed_at > now() - make_interval(secs => $1)
             ORDER BY changed_at DESC LIMIT $2",
        )
        .bind(since)
        .bind(MAX_REPUBLISHED)
        .fetch_all(&self.pool)
        .await?;
        for id in changed {
            let _ = self.changes.send(id);
        }
        Ok(())
    }
}
