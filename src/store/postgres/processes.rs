//! Which processes are alive.

use std::sync::Weak;

use tokio_util::sync::CancellationToken;

use super::super::StoreError;
use super::Inner;

/// Signs of life in the time after whose silence a process counts as dead.
const SIGNS: u32 = 5;

/// Processes that have been dead for so long are forgotten, in seconds.
const FORGOTTEN_S: i64 = 24 * 3600;

impl Inner {
    /// Says that this process is alive.
    pub(super) async fn sign_of_life(&self) -> Result<(), StoreError> {
        let alive = sqlx::query(
            "INSERT INTO processes (id, alive_until) VALUES ($1, now() + make_interval(secs => $2))
             ON CONFLICT (id) DO UPDATE SET alive_until = EXCLUDED.alive_until",
        )
        .bind(self.process)
        .bind(self.lifetime());
        self.run(alive).await.map(drop)
    }

    async fn forget_the_dead(&self) -> Result<(), StoreError> {
        let dead = sqlx::query(
            "DELETE FROM processes WHERE alive_until < now() - make_interval(secs => $1::bigint)",
        )
        .bind(FORGOTTEN_S);
        self.run(dead).await.map(drop)
    }
}

/// Says so until the store is closed.
pub(super) async fn keep_alive(store: Weak<Inner>, closed: CancellationToken) {
    let mut signs = 0;
    while let Some(inner) = store.upgrade() {
        let pause = inner.settings.lifetime / SIGNS;
        let told = match signs % 1000 {
            0 => inner.forget_the_dead().await,
            _ => Ok(()),
        };
        let told = told.and(inner.sign_of_life().await);
        if let Err(error) = told {
            tracing::warn!(%error, "the other processes cannot be told that this one is alive");
        }
        signs += 1;
        drop(inner);
        tokio::select! {
            () = closed.cancelled() => return,
            () = tokio::time::sleep(pause) => {}
        }
    }
}
