//! Limits that all processes of a store share: token buckets per minute, and a daily budget.

use std::collections::HashMap;
use std::sync::Arc;

use async_trait::async_trait;
use jiff::civil::Date;
use parking_lot::Mutex;
use tokio::time::Instant;

use super::StoreError;
use whereabouts_core::Spent;

/// A request to one token bucket. A bucket refills steadily up to one minute's worth of tokens; its
/// level may be negative.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TokenRequest {
    /// Tokens per minute, which is also the capacity; 0 for no limit.
    pub per_minute: f64,
    /// Tokens that the bucket must hold for the request to be granted.
    pub required: f64,
    /// Tokens to take; a negative amount returns them.
    pub amount: f64,
}

impl TokenRequest {
    /// A request to a bucket without a limit, which is always granted.
    pub const UNLIMITED: Self = Self { per_minute: 0.0, required: f64::MIN, amount: 0.0 };
}

/// The result of a request to two token buckets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TokenGrant {
    /// Whether both buckets held enough. If not, nothing was taken from either.
    pub granted: bool,
    /// The level of each bucket afterwards.
    pub remaining: [f64; 2],
}

/// The limits of all processes that share a store.
#[async_trait]
pub trait SharedLimits: Send + Sync {
    /// Takes tokens from both buckets of this name, or from neither. New buckets are full.
    async fn take_tokens(
        &self,
        name: &str,
        requests: [TokenRequest; 2],
    ) -> Result<TokenGrant, StoreError>;
    /// Reserves the maximum cost of a call in the budget of a day. Returns `false` if spending and
    /// reservations together would exceed the limit; a limit of 0 means none.
    ///
    /// [`UsageStore::add_usage`](super::UsageStore::add_usage) converts reservations into spending.
    async fn reserve(&self, day: Date, max_cost: Spent, limit: Spent) -> Result<bool, StoreError>;
    /// Releases the unused part of a reservation.
    async fn release(&self, day: Date, unused: Spent) -> Result<(), StoreError>;
}

/// Pairs of token buckets by name, local to this process or shared by all.
pub enum TokenBuckets {
    /// In memory.
    Local(Mutex<HashMap<String, BucketLevels>>),
    /// In a store that several processes share.
    Shared(Arc<dyn SharedLimits>),
}

/// The levels of two buckets at a moment.
#[derive(Debug, Clone, Copy)]
pub struct BucketLevels {
    tokens: [f64; 2],
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
            Self::Local(_) => "TokenBuckets::Local",
            Self::Shared(_) => "TokenBuckets::Shared",
        })
    }
}

impl TokenBuckets {
    /// Uses the shared limits if there are any, otherwise buckets of this process.
    pub fn new(shared: Option<Arc<dyn SharedLimits>>) -> Self {
        shared.map_or_else(Self::default, Self::Shared)
    }

    /// Takes tokens from both buckets of this name, or from neither; see
    /// [`SharedLimits::take_tokens`].
    pub async fn take(
        &self,
        name: &str,
        requests: [TokenRequest; 2],
    ) -> Result<TokenGrant, StoreError> {
        match self {
            Self::Shared(shared) => shared.take_tokens(name, requests).await,
            Self::Local(buckets) => {
                let mut buckets = buckets.lock();
                let now = Instant::now();
                let full = BucketLevels { tokens: requests.map(|r| r.per_minute), at: now };
                let levels = buckets.entry(name.to_owned()).or_insert(full);
                Ok(levels.take(requests, now))
            }
        }
    }
}

impl BucketLevels {
    fn take(&mut self, requests: [TokenRequest; 2], now: Instant) -> TokenGrant {
        let minutes = (now - self.at).as_secs_f64() / 60.0;
        let refilled = |index: usize| {
            let TokenRequest { per_minute, .. } = requests[index];
            (self.tokens[index] + minutes * per_minute).min(per_minute)
        };
        let refilled = [refilled(0), refilled(1)];
        // Allow for a rounding error of a thousandth of a token.
        let holds_enough = |index: usize| refilled[index] + 1e-3 > requests[index].required;
        let granted = holds_enough(0) && holds_enough(1);
        let remaining = match granted {
            true => [refilled[0] - requests[0].amount, refilled[1] - requests[1].amount],
            false => refilled,
        };
        *self = Self { tokens: remaining, at: now };
        TokenGrant { granted, remaining }
    }
}
