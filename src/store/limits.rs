//! Limits that processes keep together: how often something may be done in a minute, and how much may be spent
//! on a day.

use std::collections::HashMap;
use std::sync::Arc;

use async_trait::async_trait;
use jiff::civil::Date;
use parking_lot::Mutex;
use tokio::time::Instant;

use super::StoreError;
use whereabouts_core::Spent;

/// What is wanted of a bucket, which fills steadily up to a minute's worth. What it holds may go below zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TokenRequest {
    /// A minute's worth; 0: there is no limit.
    pub per_minute: f64,
    /// So much must be in it.
    pub needed: f64,
    /// So much is taken; below zero, it is given back.
    pub taken: f64,
}

impl TokenRequest {
    /// Of a bucket without a limit.
    pub const UNLIMITED: Self = Self { per_minute: 0.0, needed: f64::MIN, taken: 0.0 };
}

/// What two buckets hold after a draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TokenGrant {
    /// Whether both held enough, so that something was taken from both; else from neither.
    pub taken: bool,
    /// What is left in each.
    pub left: [f64; 2],
}

/// The limits of all processes that share a store.
#[async_trait]
pub trait SharedLimits: Send + Sync {
    /// Draws from the two buckets of that name; full ones, if there are none yet.
    async fn draw(&self, name: &str, draws: [TokenRequest; 2]) -> Result<TokenGrant, StoreError>;
    /// Sets aside what a call may cost at the most on that day; `false` if what was spent and set aside would
    /// then pass the limit, of which 0 is none. What is spent is taken from it by
    /// [`UsageStore::add_usage`](super::UsageStore::add_usage).
    async fn set_aside(&self, day: Date, most: Spent, limit: Spent) -> Result<bool, StoreError>;
    /// Gives back what was set aside and not needed.
    async fn give_back(&self, day: Date, unneeded: Spent) -> Result<(), StoreError>;
}

/// Buckets of this process, or of all.
pub enum Buckets {
    /// In memory.
    Here(Mutex<HashMap<String, Levels>>),
    /// In a store that processes share.
    Shared(Arc<dyn SharedLimits>),
}

/// What two buckets held at a moment.
#[derive(Debug, Clone, Copy)]
pub struct Levels {
    left: [f64; 2],
    at: Instant,
}

impl Default for Buckets {
    fn default() -> Self {
        Self::Here(Mutex::default())
    }
}

impl std::fmt::Debug for Buckets {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Here(_) => "Buckets::Here",
            Self::Shared(_) => "Buckets::Shared",
        })
    }
}

impl Buckets {
    /// Those of all processes that share a store, or of this one if it has its own.
    pub fn of(shared: Option<Arc<dyn SharedLimits>>) -> Self {
        shared.map_or_else(Self::default, Self::Shared)
    }

    /// See [`SharedLimits::draw`].
    pub async fn draw(
        &self,
        name: &str,
        draws: [TokenRequest; 2],
    ) -> Result<TokenGrant, StoreError> {
        match self {
            Self::Shared(shared) => shared.draw(name, draws).await,
            Self::Here(levels) => {
                let mut levels = levels.lock();
                let now = Instant::now();
                let full = Levels { left: draws.map(|draw| draw.per_minute), at: now };
                let known = levels.entry(name.to_owned()).or_insert(full);
                Ok(known.draw(draws, now))
            }
        }
    }
}

impl Levels {
    fn draw(&mut self, draws: [TokenRequest; 2], now: Instant) -> TokenGrant {
        let minutes = (now - self.at).as_secs_f64() / 60.0;
        let filled = |index: usize| {
            let TokenRequest { per_minute, .. } = draws[index];
            (self.left[index] + minutes * per_minute).min(per_minute)
        };
        let filled = [filled(0), filled(1)];
        // Less than a thousandth is a rounding error.
        let enough = |index: usize| filled[index] + 1e-3 > draws[index].needed;
        let taken = enough(0) && enough(1);
        let left = match taken {
            true => [filled[0] - draws[0].taken, filled[1] - draws[1].taken],
            false => filled,
        };
        *self = Self { left, at: now };
        TokenGrant { taken, left }
    }
}
