//! The rate limit on requests and tokens per minute.

use std::time::Duration;

use whereabouts_store::{TokenBuckets, TokenGrant, TokenRequest};

/// Two token buckets, for requests and for tokens, which hold a minute's worth each. Calls are served in
/// order of arrival.
#[derive(Debug)]
pub struct RateLimiter {
    /// Held by the call that is next, which keeps the others in order.
    next: tokio::sync::Mutex<()>,
    per_minute: [f64; 2],
    buckets: TokenBuckets,
}

impl RateLimiter {
    /// Creates a limiter that these buckets enforce; 0 stands for no limit.
    pub fn new(requests_per_minute: u32, tokens_per_minute: u64, buckets: TokenBuckets) -> Self {
        let per_minute = [f64::from(requests_per_minute), tokens_per_minute as f64];
        Self { next: tokio::sync::Mutex::default(), per_minute, buckets }
    }

    /// Waits until one more request of this many tokens may be sent.
    pub async fn take(&self, tokens: u64) {
        if self.per_minute == [0.0; 2] {
            return;
        }
        let _next = self.next.lock().await;
        let requests = [self.request(0, 1.0), self.request(1, tokens as f64)];
        loop {
            match self.buckets.take(NAME, requests).await {
                Ok(TokenGrant { granted: true, .. }) => return,
                Ok(TokenGrant { remaining, .. }) => {
                    let wait = [0, 1].map(|index| refill_time(requests[index], remaining[index]));
                    tokio::time::sleep(wait[0].max(wait[1]).max(TIMER_RESOLUTION)).await;
                }
                Err(error) => {
                    tracing::warn!(%error, "the rate limit cannot be checked; retrying");
                    tokio::time::sleep(STORE_RETRY_PAUSE).await;
                }
            }
        }
    }

    /// Replaces the estimated tokens of a sent request by their actual number.
    pub async fn settle(&self, taken: u64, used: u64) {
        if self.per_minute[1] == 0.0 {
            return;
        }
        let taken = (taken as f64).min(self.per_minute[1]);
        let unchanged = TokenRequest { required: f64::MIN, amount: 0.0, ..self.request(0, 0.0) };
        let corrected = TokenRequest {
            required: f64::MIN,
            amount: used as f64 - taken,
            ..self.request(1, 0.0)
        };
        if let Err(error) = self.buckets.take(NAME, [unchanged, corrected]).await {
            tracing::warn!(%error, "unused tokens could not be returned to the rate limit");
        }
    }

    /// Returns the request to a bucket. A cost above a minute's worth is cut to it, because the bucket never
    /// holds more.
    fn request(&self, index: usize, cost: f64) -> TokenRequest {
        let per_minute = self.per_minute[index];
        if per_minute == 0.0 {
            return TokenRequest::UNLIMITED;
        }
        let cost = cost.min(per_minute);
        TokenRequest { per_minute, required: cost, amount: cost }
    }
}

/// Returns how long it is until a bucket holds what a request needs.
fn refill_time(request: TokenRequest, left: f64) -> Duration {
    if request.per_minute == 0.0 {
        return Duration::ZERO;
    }
    Duration::from_secs_f64((request.required - left).max(0.0) * 60.0 / request.per_minute)
}

/// The name under which processes share the buckets.
const NAME: &str = "mllm";

/// The pause after the store of shared buckets could not be reached.
const STORE_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// The resolution of tokio's timers.
const TIMER_RESOLUTION: Duration = Duration::from_millis(1);

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::Instant;

    #[tokio::test(start_paused = true)]
    async fn requests_beyond_a_minutes_worth_wait() {
        let limiter = RateLimiter::new(60, 0, TokenBuckets::default());
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
    async fn unused_tokens_are_returned() {
        let limiter = RateLimiter::new(0, 6000, TokenBuckets::default());
        let start = Instant::now();
        limiter.take(6000).await;
        limiter.settle(6000, 1000).await;
        limiter.take(5000).await;
        assert_eq!(start.elapsed(), Duration::ZERO);
        limiter.take(100).await;
        let waited = start.elapsed().as_secs_f64();
        assert!((waited - 1.0).abs() < 0.01, "{waited}");
    }

    #[tokio::test(start_paused = true)]
    async fn a_request_larger_than_the_bucket_is_sent_when_the_bucket_is_full() {
        let limiter = RateLimiter::new(0, 100, TokenBuckets::default());
        limiter.take(1_000_000).await;
        let start = Instant::now();
        limiter.take(1_000_000).await;
        assert!(start.elapsed() <= Duration::from_secs(61));
    }

    #[tokio::test]
    async fn no_limit_never_waits() {
        let limiter = RateLimiter::new(0, 0, TokenBuckets::default());
        for _ in 0..10_000 {
            limiter.take(u64::MAX).await;
        }
    }
}
