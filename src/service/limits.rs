//! How much each API key may ask for: what has come lately, in memory.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::{Caller, ErrorKind, ServiceError};
use crate::domain::ApiKey;

/// A bucket of a key fills up in this time.
const WINDOW: Duration = Duration::from_secs(60);

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
pub struct Limits(Mutex<HashMap<String, Buckets>>);

#[derive(Debug, Default)]
struct Buckets {
    requests: Option<Bucket>,
    bytes: Option<Bucket>,
}

/// What is left at a moment; below zero after a body that was larger than what was left.
#[derive(Debug, Clone, Copy)]
struct Bucket {
    left: f64,
    at: Instant,
}

impl Bucket {
    fn filled(bucket: Option<Self>, limit: f64, now: Instant) -> Self {
        let Some(known) = bucket else { return Self { left: limit, at: now } };
        let passed = now.duration_since(known.at).as_secs_f64() / WINDOW.as_secs_f64();
        Self { left: (known.left + passed * limit).min(limit), at: now }
    }

    fn allowance(self, limit: f64) -> Allowance {
        let missing = (limit - self.left) / limit;
        Allowance {
            limit: limit as u64,
            remaining: self.left.max(0.0) as u64,
            reset: WINDOW.mul_f64(missing.max(0.0)),
        }
    }
}

impl Limits {
    /// Takes a request from what is left to a key.
    pub fn take_request(&self, key: &ApiKey) -> (Allowances, Result<(), ServiceError>) {
        let mut buckets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let of_key = buckets.entry(key.id.clone()).or_default();
        let mut allowances = Allowances::default();
        let mut refused = None;
        if let Some(limit) = key.limits.bytes_per_minute.map(|limit| limit as f64) {
            let bucket = Bucket::filled(of_key.bytes, limit, now);
            of_key.bytes = Some(bucket);
            allowances.bytes = Some(bucket.allowance(limit));
            if bucket.left <= 0.0 {
                let pause = WINDOW.mul_f64((1.0 - bucket.left).max(1.0) / limit);
                refused = Some((pause, format!("{limit} bytes")));
            }
        }
        if let Some(limit) = key.limits.requests_per_minute.map(f64::from) {
            let mut bucket = Bucket::filled(of_key.requests, limit, now);
            if bucket.left < 1.0 {
                let pause = WINDOW.mul_f64((1.0 - bucket.left) / limit);
                refused = Some((pause, format!("{limit} requests")));
            } else if refused.is_none() {
                bucket.left -= 1.0;
            }
            of_key.requests = Some(bucket);
            allowances.requests = Some(bucket.allowance(limit));
        }
        let Some((pause, what)) = refused else { return (allowances, Ok(())) };
        let detail = format!(
            "the key {} has used up its {what} a minute; wait as Retry-After says, or have an admin make \
             one with another limit",
            key.id
        );
        let error = ServiceError::new(ErrorKind::Overloaded, detail).retry_after(pause);
        (allowances, Err(error))
    }

    /// Takes one of several things that came in one request from the requests left to a key.
    pub fn take_one_more(&self, caller: &Caller) -> Result<(), ServiceError> {
        match caller {
            Caller::Anybody => Ok(()),
            Caller::Holder(key) => self.take_request(key).1,
        }
    }

    /// Takes bytes that have come from what is left to a key.
    pub fn take_bytes(&self, key: &ApiKey, bytes: usize) {
        let Some(limit) = key.limits.bytes_per_minute else { return };
        let mut buckets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let of_key = buckets.entry(key.id.clone()).or_default();
        let bucket = Bucket::filled(of_key.bytes, limit as f64, Instant::now());
        of_key.bytes = Some(Bucket { left: bucket.left - bytes as f64, ..bucket });
    }
}
