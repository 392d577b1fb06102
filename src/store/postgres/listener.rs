//! Hears from the database what other processes have changed.
//!
//! Notices are lost while the connection is. After that, the jobs that changed meanwhile are told of again.

use std::sync::Weak;
use std::time::{Duration, Instant};

use sqlx::PgPool;
use sqlx::postgres::{PgConnectOptions, PgListener, PgNotification, PgPoolOptions};
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

/// A connection that hears from now on. It is in no pool: one that has died in silence would keep its place
/// there for long.
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
    let (mut first, mut heard_at) = (Some(first), Instant::now());
    loop {
        let heard = tokio::select! {
            () = closed.cancelled() => return,
            heard = hear(first.take(), &store, &mut heard_at) => heard,
        };
        if store.strong_count() == 0 {
            return;
        }
        if let Err(error) = heard {
            tracing::warn!(%error, "what other processes change is not heard; trying again");
        }
        tokio::select! {
            () = closed.cancelled() => return,
            () = tokio::time::sleep(PAUSE) => {}
        }
    }
}

/// Listens until the connection is lost; notes when it was last there.
async fn hear(
    connected: Option<PgListener>,
    store: &Weak<Inner>,
    heard_at: &mut Instant,
) -> Result<(), StoreError> {
    let Some(inner) = store.upgrade() else { return Ok(()) };
    let timeout = inner.settings.timeout;
    let mut listener = match connected {
        Some(listener) => listener,
        None => {
            let listener = inner.call(connect(&inner.pool)).await?;
            inner.call(inner.tell_again(heard_at.elapsed())).await?;
            listener
        }
    };
    drop(inner);
    loop {
        *heard_at = Instant::now();
        let notice = tokio::time::timeout(timeout, listener.try_recv()).await;
        let Some(inner) = store.upgrade() else { return Ok(()) };
        match notice {
            Ok(notice) => {
                let lost = || super::unavailable("the connection was lost");
                inner.tell(&notice?.ok_or_else(lost)?);
            }
            // Nothing has happened, or the connection is dead.
            Err(_) => {
                let ask = sqlx::query("SELECT 1").execute(&mut listener);
                inner.call(async { Ok(ask.await?) }).await?;
            }
        }
    }
}

impl Inner {
    fn tell(&self, notice: &PgNotification) {
        match notice.channel() {
            JOBS => {
                if let Ok(id) = notice.payload().parse::<Uuid>() {
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
