//! Requests and tokens a minute.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// Two buckets that fill steadily up to a minute's worth. Callers are served in order.
#[derive(Debug)]
pub struct RateLimiter {
    /// Whoever holds it is the next to be served.
    turn: tokio::sync::Mutex<()>,
    buckets: Mutex<[Option<Bucket>; 2]>,
}

#[derive(Debug)]
struct Bucket {
    per_minute: f64,
    level: f64,
    filled_at: Instant,
}

impl RateLimiter {
    /// Full buckets; 0 for no limit.
    pub fn new(requests_per_minute: u32, tokens_per_minute: u64) -> Self {
        let bucket = |per_minute: f64| {
            (per_minute > 0.0).then(|| Bucket {
                per_minute,
                level: per_minute,
                filled_at: Instant::now(),
            })
        };
        let buckets = [bucket(f64::from(requests_per_minute)), bucket(tokens_per_minute as f64)];
        Self { turn: tokio::sync::Mutex::default(), buckets: Mutex::new(buckets) }
    }

    /// Waits until one more request with so many tokens may be sent.
    pub async fn take(&self, tokens: u64) {
        let _turn = self.turn.lock().await;
        while let Some(wait) = self.take_now(tokens) {
            tokio::time::sleep(wait).await;
        }
    }

    /// Corrects what was taken for a request by what it needed.
    pub fn settle(&self, taken: u64, used: u64) {
        if let [_, Some(tokens)] = &mut *self.buckets() {
            let taken = (taken as f64).min(tokens.per_minute);
            tokens.level = (tokens.level + taken - used as f64).min(tokens.per_minute);
        }
    }

    /// Takes, or says how long to wait.
    fn take_now(&self, tokens: u64) -> Option<Duration> {
        let mut buckets = self.buckets();
        let costs = [1.0, tokens as f64];
        let wait = buckets
            .iter_mut()
            .zip(costs)
            .filter_map(|(bucket, cost)| bucket.as_mut()?.lacks(cost))
            .max();
        if wait.is_none() {
            for (bucket, cost) in buckets.iter_mut().zip(costs) {
                if let Some(bucket) = bucket {
                    bucket.level -= cost.min(bucket.per_minute);
                }
            }
        }
        wait
    }

    fn buckets(&self) -> MutexGuard<'_, [Option<Bucket>; 2]> {
        self.buckets.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Bucket {
    /// How long until it holds `cost`; a cost above a minute's worth is one minute's worth, or it
    /// would wait for ever.
    fn lacks(&mut self, cost: f64) -> Option<Duration> {
        let now = Instant::now();
        let gained = (now - self.filled_at).as_secs_f64() * self.per_minute / 60.0;
        self.level = (self.level + gained).min(self.per_minute);
        self.filled_at = now;
        let missing = cost.min(self.per_minute) - self.level;
        // Less than a thousandth of a token is a rounding error.
        (missing > 1e-3)
            .then(|| Duration::from_secs_f64(missing * 60.0 / self.per_minute).max(FINEST))
    }
}

/// tokio's timers know no shorter time.
const FINEST: Duration = Duration::from_millis(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn requests_beyond_a_minutes_worth_wait() {
        let limiter = RateLimiter::new(60, 0);
        let start = Instant::now();
        for _ in 0..60 {
            limiter.take(1_000_000).await;
        }
        assert_eq!(start.elapsed(), Duration::ZERO);
        limiter.take(0).await;
        limiter.take(0).await;
        let waited = start.elapsed().as_secs_f64();
        assert!((waited - 2.0).abs() < 0.01, "{waited}");
    }

    #[tokio::test(start_paused = true)]
    async fn tokens_not_needed_are_given_back() {
        let limiter = RateLimiter::new(0, 6000);
        let start = Instant::now();
        limiter.take(6000).await;
        limiter.settle(6000, 1000);
        limiter.take(5000).await;
        assert_eq!(start.elapsed(), Duration::ZERO);
        limiter.take(100).await;
        let waited = start.elapsed().as_secs_f64();
        assert!((waited - 1.0).abs() < 0.01, "{waited}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_request_larger_than_the_bucket_is_sent_all_the_same() {
        let limiter = RateLimiter::new(0, 100);
        limiter.take(1_000_000).await;
        let start = Instant::now();
        limiter.take(1_000_000).await;
        assert!(start.elapsed() <= Duration::from_secs(61));
    }

    #[tokio::test]
    async fn no_limit_never_waits() {
        let limiter = RateLimiter::new(0, 0);
        for _ in 0..10_000 {
            limiter.take(u64::MAX).await;
        }
    }
}
