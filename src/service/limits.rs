//! Rate limits of API keys: token buckets of requests and bytes, each with a minute's worth.

use std::time::Duration;

use super::{Principal, ServiceError};
use whereabouts_api::ErrorKind;
use whereabouts_core::ApiKey;
use whereabouts_store::{TokenBuckets, TokenGrant, TokenRequest};

/// Time in which an empty bucket fills up.
const WINDOW: Duration = Duration::from_secs(60);

/// Tokens that a bucket of bytes must hold for a request whose size is not known yet.
const ANY_BYTES: f64 = 0.01;

/// What remains of one limit of a key (`RateLimit` header fields).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RemainingLimit {
    /// The limit per minute.
    pub limit: u64,
    /// Tokens that remain.
    pub remaining: u64,
    /// Time until the bucket is full again.
    pub reset: Duration,
}

/// What remains of the limits of a key; `None` where it has no limit.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RemainingLimits {
    /// Requests.
    pub requests: Option<RemainingLimit>,
    /// Bytes of request bodies.
    pub bytes: Option<RemainingLimit>,
}

/// The token buckets of all keys, by the id of the key.
#[derive(Debug, Default)]
pub struct Limits(TokenBuckets);

impl Limits {
    /// Limits kept in these buckets.
    pub fn new(buckets: TokenBuckets) -> Self {
        Self(buckets)
    }

    /// Takes one request from the buckets of a key. Also returns what remains.
    pub async fn take_request(&self, key: &ApiKey) -> (RemainingLimits, Result<(), ServiceError>) {
        let tokens = [requests(key), bytes(key, ANY_BYTES, 0.0)];
        if tokens.iter().all(|bucket| bucket.per_minute == 0.0) {
            return (RemainingLimits::default(), Ok(()));
        }
        let TokenGrant { granted, remaining } = match self.0.take(&key.id, tokens).await {
            Ok(grant) => grant,
            Err(error) => return (RemainingLimits::default(), Err(error.into())),
        };
        let [requests, bytes] = [0, 1].map(|index| {
            let limit = tokens[index].per_minute;
            (limit > 0.0).then(|| (limit, remaining[index]))
        });
        let allowances = RemainingLimits {
            requests: requests.map(|(limit, left)| allowance(limit, left)),
            bytes: bytes.map(|(limit, left)| allowance(limit, left)),
        };
        if granted {
            return (allowances, Ok(()));
        }
        let (pause, what) = match (requests, bytes) {
            (Some((limit, left)), _) if left < 1.0 => {
                (WINDOW.mul_f64((1.0 - left) / limit), format!("{limit} requests"))
            }
            (_, bytes) => {
                let (limit, left) = bytes.unwrap_or((1.0, 0.0));
                (WINDOW.mul_f64((1.0 - left).max(1.0) / limit), format!("{limit} bytes"))
            }
        };
        let detail = format!(
            "the key {} has used up its {what} per minute; wait as Retry-After says, or ask an admin for \
             a key with a higher limit",
            key.id
        );
        let error = ServiceError::new(ErrorKind::Overloaded, detail).retry_after(pause);
        (allowances, Err(error))
    }

    /// Takes one more request from the buckets of a caller, for each item of a request after the first.
    pub async fn take_extra_request(&self, caller: &Principal) -> Result<(), ServiceError> {
        match caller {
            Principal::Anonymous => Ok(()),
            Principal::ApiKey(key) => self.take_request(key).await.1,
        }
    }

    /// Takes the bytes of a request body that was received from the bucket of a key.
    pub async fn take_bytes(&self, key: &ApiKey, count: usize) {
        if key.limits.bytes_per_minute.is_none() || count == 0 {
            return;
        }
        let requests = TokenRequest { required: f64::MIN, amount: 0.0, ..requests(key) };
        if let Err(error) =
            self.0.take(&key.id, [requests, bytes(key, f64::MIN, count as f64)]).await
        {
            tracing::warn!(%error, "the bytes of a request body could not be counted");
        }
    }
}

fn requests(key: &ApiKey) -> TokenRequest {
    key.limits.requests_per_minute.map_or(TokenRequest::UNLIMITED, |limit| TokenRequest {
        per_minute: f64::from(limit),
        required: 1.0,
        amount: 1.0,
    })
}

/// A body may be larger than what remains: the bucket then goes below zero.
fn bytes(key: &ApiKey, required: f64, amount: f64) -> TokenRequest {
    let bytes = |limit| TokenRequest { per_minute: limit as f64, required, amount };
    key.limits.bytes_per_minute.map_or(TokenRequest::UNLIMITED, bytes)
}

fn allowance(limit: f64, left: f64) -> RemainingLimit {
    let missing = (limit - left) / limit;
    RemainingLimit {
        limit: limit as u64,
        // Rounded as the buckets round.
        remaining: (left.max(0.0) + 1e-3) as u64,
        reset: WINDOW.mul_f64(missing.max(0.0)),
    }
}
