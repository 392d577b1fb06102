//! Heartbeats of processes.

use std::sync::Weak;

use tokio_util::sync::CancellationToken;

use super::super::StoreError;
use super::Inner;

/// Heartbeats per lifetime: a process is considered dead after missing this many.
const HEARTBEATS_PER_LIFETIME: u32 = 5;

/// Heartbeats between two removals of dead processes.
const REMOVAL_INTERVAL: u32 = 1000;

/// How long dead processes stay in the table, in seconds.
const DEAD_RETENTION_S: i64 = 24 * 3600;

impl Inner {
    /// Records that this process is alive.
    pub(super) async fn heartbeat(&self) -> Result<(), StoreError> {
        let alive = sqlx::query(
            "INSERT INTO processes (id, alive_until) VALUES ($1, now() + make_interval(secs => $2))
             ON CONFLICT (id) DO UPDATE SET alive_until = EXCLUDED.alive_until",
        )
        .bind(self.process)
        .bind(self.lifetime());
        self.run(alive).await.map(drop)
    }

    async fn remove_dead_processes(&self) -> Result<(), StoreError> {
        let dead = sqlx::query(
            "DELETE FROM processes WHERE alive_until < now() - make_interval(secs => $1::bigint)",
        )
        .bind(DEAD_RETENTION_S);
        self.run(dead).await.map(drop)
    }
}

/// Sends heartbeats until the store is closed.
pub(super) async fn send_heartbeats(store: Weak<Inner>, closed: CancellationToken) {
    let mut sent: u32 = 0;
    while let Some(inner) = store.upgrade() {
        let pause = inner.settings.lifetime / HEARTBEATS_PER_LIFETIME;
        let removed = match sent % REMOVAL_INTERVAL {
            0 => inner.remove_dead_processes().await,
            _ => Ok(()),
        };
        let heartbeat = removed.and(inner.heartbeat().await);
        if let Err(error) = heartbeat {
            tracing::warn!(%error, "cannot send a heartbeat; other processes may consider this one dead");
        }
        sent = sent.wrapping_add(1);
        drop(inner);
        tokio::select! {
            () = closed.cancelled() => return,
            () = tokio::time::sleep(pause) => {}
        }
    }
}
