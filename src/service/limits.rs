//! How much each API key may ask for.

use std::time::Duration;

use super::{Principal, ServiceError};
use whereabouts_api::ErrorKind;
use whereabouts_core::ApiKey;
use whereabouts_store::{TokenBuckets, TokenGrant, TokenRequest};

/// A bucket of a key fills up in this time.
const WINDOW: Duration = Duration::from_secs(60);

/// As good as nothing.
const SOME: f64 = 0.01;

/// What is left to a key, of one of its limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Allowance {
    /// The limit.
    pub limit: u64,
    /// What is left of it.
    pub remaining: u64,
    /// When all of it is there again.
    pub reset: Duration,
}

/// What is left to a key.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Allowances {
    /// Of requests.
    pub requests: Option<Allowance>,
    /// Of bytes.
    pub bytes: Option<Allowance>,
}

/// What each key has asked for lately, by its id.
#[derive(Debug, Default)]
pub struct Limits(TokenBuckets);

impl Limits {
    /// Limits that these buckets keep.
    pub fn new(buckets: TokenBuckets) -> Self {
        Self(buckets)
    }

    /// Takes a request from what is left to a key.
    pub async fn take_request(&self, key: &ApiKey) -> (Allowances, Result<(), ServiceError>) {
        let draws = [requests(key), bytes(key, SOME, 0.0)];
        if draws.iter().all(|draw| draw.per_minute == 0.0) {
            return (Allowances::default(), Ok(()));
        }
        let TokenGrant { granted, remaining } = match self.0.take(&key.id, draws).await {
            Ok(drawn) => drawn,
            Err(error) => return (Allowances::default(), Err(error.into())),
        };
        let [requests, bytes] = [0, 1].map(|index| {
            let limit = draws[index].per_minute;
            (limit > 0.0).then(|| (limit, remaining[index]))
        });
        let allowances = Allowances {
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
            "the key {} has used up its {what} a minute; wait as Retry-After says, or have an admin make \
             one with another limit",
            key.id
        );
        let error = ServiceError::new(ErrorKind::Overloaded, detail).retry_after(pause);
        (allowances, Err(error))
    }

    /// Takes one of several things that came in one request from the requests left to a key.
    pub async fn take_one_more(&self, caller: &Principal) -> Result<(), ServiceError> {
        match caller {
            Principal::Anonymous => Ok(()),
            Principal::ApiKey(key) => self.take_request(key).await.1,
        }
    }

    /// Takes bytes that have come from what is left to a key.
    pub async fn take_bytes(&self, key: &ApiKey, count: usize) {
        if key.limits.bytes_per_minute.is_none() || count == 0 {
            return;
        }
        let requests = TokenRequest { required: f64::MIN, amount: 0.0, ..requests(key) };
        if let Err(error) =
            self.0.take(&key.id, [requests, bytes(key, f64::MIN, count as f64)]).await
        {
            tracing::warn!(%error, "the bytes of a body are not counted");
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

/// A body may be larger than what is left: then there is less than nothing for a while.
fn bytes(key: &ApiKey, required: f64, amount: f64) -> TokenRequest {
    let bytes = |limit| TokenRequest { per_minute: limit as f64, required, amount };
    key.limits.bytes_per_minute.map_or(TokenRequest::UNLIMITED, bytes)
}

fn allowance(limit: f64, left: f64) -> Allowance {
    let missing = (limit - left) / limit;
    Allowance {
        limit: limit as u64,
        // As a draw rounds.
        remaining: (left.max(0.0) + 1e-3) as u64,
        reset: WINDOW.mul_f64(missing.max(0.0)),
    }
}
