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
    pub required: f64,
    /// So much is taken; below zero, it is given back.
    pub amount: f64,
}

impl TokenRequest {
    /// Of a bucket without a limit.
    pub const UNLIMITED: Self = Self { per_minute: 0.0, required: f64::MIN, amount: 0.0 };
}

/// What two buckets hold after a draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TokenGrant {
    /// Whether both held enough, so that something was taken from both; else from neither.
    pub granted: bool,
    /// What is left in each.
    pub remaining: [f64; 2],
}

/// The limits of all processes that share a store.
#[async_trait]
pub trait SharedLimits: Send + Sync {
    /// Draws from the two buckets of that name; full ones, if there are none yet.
    async fn take_tokens(
        &self,
        name: &str,
        draws: [TokenRequest; 2],
    ) -> Result<TokenGrant, StoreError>;
    /// Sets aside what a call may cost at the most on that day; `false` if what was spent and set aside would
    /// then pass the limit, of which 0 is none. What is spent is taken from it by
    /// [`UsageStore::add_usage`](super::UsageStore::add_usage).
    async fn reserve(&self, day: Date, most: Spent, limit: Spent) -> Result<bool, StoreError>;
    /// Gives back what was set aside and not needed.
    async fn release(&self, day: Date, unneeded: Spent) -> Result<(), StoreError>;
}

/// TokenBuckets of this process, or of all.
pub enum TokenBuckets {
    /// In memory.
    Local(Mutex<HashMap<String, Levels>>),
    /// In a store that processes share.
    Shared(Arc<dyn SharedLimits>),
}

/// What two buckets held at a moment.
#[derive(Debug, Clone, Copy)]
pub struct Levels {
    left: [f64; 2],
    at: Instant,
}

impl Default for TokenBuckets {
    fn default() -> Self {
        Self::Local(Mutex::default())
    }
}

impl std::fmt::Debug for TokenBuckets {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Local(_) => "TokenBuckets::Here",
            Self::Shared(_) => "TokenBuckets::Shared",
        })
    }
}

impl TokenBuckets {
    /// Those of all processes that share a store, or of this one if it has its own.
    pub fn new(shared: Option<Arc<dyn SharedLimits>>) -> Self {
        shared.map_or_else(Self::default, Self::Shared)
    }

    /// See [`SharedLimits::take_tokens`].
    pub async fn take(
        &self,
        name: &str,
        draws: [TokenRequest; 2],
    ) -> Result<TokenGrant, StoreError> {
        match self {
            Self::Shared(shared) => shared.take_tokens(name, draws).await,
            Self::Local(levels) => {
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
        let enough = |index: usize| filled[index] + 1e-3 > draws[index].required;
        let granted = enough(0) && enough(1);
        let left = match granted {
            true => [filled[0] - draws[0].amount, filled[1] - draws[1].amount],
            false => filled,
        };
        *self = Self { left, at: now };
        TokenGrant { granted, remaining: left }
    }
}
