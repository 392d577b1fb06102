//! Requests and tokens a minute.

use std::time::Duration;

use whereabouts_store::{TokenBuckets, TokenGrant, TokenRequest};

/// Two buckets that fill steadily up to a minute's worth. Callers are served in order.
#[derive(Debug)]
pub struct RateLimiter {
    /// Whoever holds it is the next to be served.
    turn: tokio::sync::Mutex<()>,
    per_minute: [f64; 2],
    buckets: TokenBuckets,
}

impl RateLimiter {
    /// Limits that these buckets keep; 0 for none.
    pub fn new(requests_per_minute: u32, tokens_per_minute: u64, buckets: TokenBuckets) -> Self {
        let per_minute = [f64::from(requests_per_minute), tokens_per_minute as f64];
        Self { turn: tokio::sync::Mutex::default(), per_minute, buckets }
    }

    /// Waits until one more request with so many tokens may be sent.
    pub async fn take(&self, tokens: u64) {
        if self.per_minute == [0.0; 2] {
            return;
        }
        let _turn = self.turn.lock().await;
        let draws = [self.draw(0, 1.0), self.draw(1, tokens as f64)];
        loop {
            match self.buckets.take(NAME, draws).await {
                Ok(TokenGrant { granted: true, .. }) => return,
                Ok(TokenGrant { remaining, .. }) => {
                    let wait = [0, 1].map(|index| missing(draws[index], remaining[index]));
                    tokio::time::sleep(wait[0].max(wait[1]).max(FINEST)).await;
                }
                Err(error) => {
                    tracing::warn!(%error, "it is not known whether a call may be made; trying again");
                    tokio::time::sleep(ASK_AGAIN).await;
                }
            }
        }
    }

    /// Corrects what was taken for a request by what it needed.
    pub async fn settle(&self, taken: u64, used: u64) {
        if self.per_minute[1] == 0.0 {
            return;
        }
        let taken = (taken as f64).min(self.per_minute[1]);
        let nothing = TokenRequest { required: f64::MIN, amount: 0.0, ..self.draw(0, 0.0) };
        let corrected =
            TokenRequest { required: f64::MIN, amount: used as f64 - taken, ..self.draw(1, 0.0) };
        if let Err(error) = self.buckets.take(NAME, [nothing, corrected]).await {
            tracing::warn!(%error, "tokens that were not needed are not given back");
        }
    }

    /// A cost above a minute's worth is one minute's worth, or it would wait for ever.
    fn draw(&self, index: usize, cost: f64) -> TokenRequest {
        let per_minute = self.per_minute[index];
        if per_minute == 0.0 {
            return TokenRequest::UNLIMITED;
        }
        let cost = cost.min(per_minute);
        TokenRequest { per_minute, required: cost, amount: cost }
    }
}

/// How long it is until a bucket holds what is needed.
fn missing(draw: TokenRequest, left: f64) -> Duration {
    if draw.per_minute == 0.0 {
        return Duration::ZERO;
    }
    Duration::from_secs_f64((draw.required - left).max(0.0) * 60.0 / draw.per_minute)
}

/// The name of the buckets of calls to the model.
const NAME: &str = "mllm";

/// The pause after buckets could not be reached.
const ASK_AGAIN: Duration = Duration::from_secs(1);

/// tokio's timers know no shorter time.
const FINEST: Duration = Duration::from_millis(1);

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
    async fn tokens_not_needed_are_given_back() {
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
    async fn a_request_larger_than_the_bucket_is_sent_all_the_same() {
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
