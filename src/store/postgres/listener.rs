//! Hears from the database what other processes have changed.
//!
//! Notices are lost while the connection is. After that, the jobs that changed meanwhile are told of again.

use std::sync::Weak;
use std::time::Duration;

use sqlx::PgPool;
use sqlx::postgres::PgListener;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::super::StoreError;
use super::Inner;

/// A job changed: its id.
pub(super) const JOBS: &str = "whereabouts_jobs";
/// Deliveries to webhooks were queued.
pub(super) const DELIVERIES: &str = "whereabouts_deliveries";
/// A key was made or revoked.
pub(super) const KEYS: &str = "whereabouts_keys";

/// The pause before a lost connection is made again.
const PAUSE: Duration = Duration::from_millis(250);

/// The most jobs that are told of again.
const TOLD_AGAIN: i64 = 1000;

/// Listens until the store is closed.
pub(super) async fn listen(pool: PgPool, store: Weak<Inner>, closed: CancellationToken) {
    let mut lost_at = None;
    loop {
        let heard = tokio::select! {
            () = closed.cancelled() => return,
            heard = hear(&pool, &store, lost_at) => heard,
        };
        let Some(inner) = store.upgrade() else { return };
        if let Err(error) = heard {
            tracing::warn!(%error, "what other processes change is not heard; trying again");
        }
        lost_at = Some(std::time::Instant::now());
        drop(inner);
        tokio::select! {
            () = closed.cancelled() => return,
            () = tokio::time::sleep(PAUSE) => {}
        }
    }
}

/// Listens until the connection is lost.
async fn hear(
    pool: &PgPool,
    store: &Weak<Inner>,
    lost_at: Option<std::time::Instant>,
) -> Result<(), StoreError> {
    let mut listener = PgListener::connect_with(pool).await?;
    listener.ignore_pool_close_event(true);
    listener.eager_reconnect(false);
    listener.listen_all([JOBS, DELIVERIES, KEYS]).await?;
    if let (Some(lost_at), Some(inner)) = (lost_at, store.upgrade()) {
        inner.tell_again(lost_at.elapsed()).await?;
    }
    while let Some(notice) = listener.try_recv().await? {
        let Some(inner) = store.upgrade() else { return Ok(()) };
        match notice.channel() {
            JOBS => {
                if let Ok(id) = notice.payload().parse::<Uuid>() {
                    let _ = inner.changes.send(id);
                }
            }
            DELIVERIES => {
                inner.deliveries.send_replace(());
            }
            KEYS => {
                inner.keys.send_replace(());
            }
            _ => {}
        }
    }
    Err(super::unavailable("the connection was lost"))
}

impl Inner {
    /// Tells of what may have changed while nothing was heard.
    async fn tell_again(&self, silence: Duration) -> Result<(), StoreError> {
        self.deliveries.send_replace(());
        self.keys.send_replace(());
        // The database may have been away for part of the time; a generous margin costs little.
        let since = silence.as_secs_f64() + 2.0 * self.settings.timeout.as_secs_f64();
        let changed: Vec<Uuid> = sqlx::query_scalar(
            "SELECT id FROM jobs WHERE changed_at > now() - make_interval(secs => $1)
             ORDER BY changed_at DESC LIMIT $2",
        )
        .bind(since)
        .bind(TOLD_AGAIN)
        .fetch_all(&self.pool)
        .await?;
        for id in changed {
            let _ = self.changes.send(id);
        }
        Ok(())
    }
}
