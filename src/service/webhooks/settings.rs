//! Bounds of webhooks, and the retry policy of deliveries.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde::{Deserialize, Serialize};

use super::super::retention::before;
use whereabouts_core::Disposition;
use whereabouts_store::DeliveryRetention;

/// Maximum number of retries, and the maximum pause before one, in seconds.
const MAX_RETRIES: usize = 32;
const MAX_PAUSE_S: u64 = 7 * 24 * 3600;

/// Maximum timeout of an attempt, in seconds.
const MAX_TIMEOUT_S: u64 = 120;

/// Jitter: a pause is extended by up to this share of it, so that messages that failed together are not retried
/// together.
const JITTER: f64 = 0.2;

/// `[webhooks]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhookSettings {
    /// Maximum number of webhooks.
    pub max: usize,
    /// Timeout of an attempt, in seconds.
    pub timeout_s: u64,
    /// Maximum number of attempts in progress.
    pub concurrency: usize,
    /// Maximum number of attempts in progress for one webhook.
    pub concurrency_each: usize,
    /// Pauses before the second and further attempts, in seconds.
    pub retry_s: Vec<u64>,
    /// Maximum Retry-After of a receiver that is respected, in seconds.
    pub retry_after_max_s: u64,
    /// How long a delivery is kept after it has ended, in days; 0 for no limit.
    pub keep_days: u32,
    /// Maximum number of deliveries that are kept.
    pub max_deliveries: usize,
    /// Whether messages may be sent to addresses that are not public.
    pub allow_private: bool,
}

impl WebhookSettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        let at_least_one = [
            ("max", self.max),
            ("concurrency", self.concurrency),
            ("concurrency_each", self.concurrency_each),
            ("max_deliveries", self.max_deliveries),
        ];
        if let Some((key, _)) = at_least_one.iter().find(|(_, value)| *value == 0) {
            return Some(format!("webhooks.{key} must be at least 1"));
        }
        if !(1..=MAX_TIMEOUT_S).contains(&self.timeout_s) {
            return Some(format!("webhooks.timeout_s must be 1 to {MAX_TIMEOUT_S}"));
        }
        if self.concurrency_each > self.concurrency {
            return Some("webhooks.concurrency_each must not exceed webhooks.concurrency".into());
        }
        let too_long = |seconds: &u64| *seconds > MAX_PAUSE_S;
        if self.retry_s.len() > MAX_RETRIES || self.retry_s.iter().any(too_long) {
            return Some(format!(
                "webhooks.retry_s must have at most {MAX_RETRIES} pauses of at most {MAX_PAUSE_S} \
                 seconds"
            ));
        }
        if too_long(&self.retry_after_max_s) {
            return Some(format!("webhooks.retry_after_max_s must be at most {MAX_PAUSE_S}"));
        }
        None
    }

    pub(super) fn timeout(&self) -> Duration {
        Duration::from_secs(self.timeout_s)
    }

    /// Which deliveries are to be kept at `now`.
    pub(super) fn keep(&self, now: Timestamp) -> DeliveryRetention {
        let age = Duration::from_secs(u64::from(self.keep_days) * 24 * 3600);
        let since = (!age.is_zero()).then(|| before(now, age));
        DeliveryRetention { since, most: self.max_deliveries }
    }

    /// The retry policy: what to do with a delivery whose attempt failed after `attempts` earlier ones. `jitter` is a
    /// random fraction, 0 to 1.
    pub(super) fn after_failure(
        &self,
        attempts: u32,
        retry_after: Option<Duration>,
        now: Timestamp,
        jitter: f64,
    ) -> Disposition {
        let Some(pause) = self.retry_s.get(attempts as usize) else { return Disposition::Dead };
        let pause = Duration::from_secs(*pause).mul_f64(1.0 + JITTER * jitter);
        let requested = retry_after.unwrap_or_default();
        let pause = pause.max(requested.min(Duration::from_secs(self.retry_after_max_s)));
        let pause = SignedDuration::try_from(pause).unwrap_or(SignedDuration::ZERO);
        Disposition::RetryAt(now.saturating_add(pause).unwrap_or(now))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    pub fn defaults() -> WebhookSettings {
        #[derive(Deserialize)]
        struct File {
            webhooks: WebhookSettings,
        }
        toml::from_str::<File>(include_str!("../../../deploy/whereabouts.toml")).unwrap().webhooks
    }

    #[test]
    fn a_delivery_is_retried_after_the_configured_pauses_with_jitter_and_then_dead() {
        let (settings, now) = (defaults(), Timestamp::now());
        let pause = |attempts, jitter| match settings.after_failure(attempts, None, now, jitter) {
            Disposition::RetryAt(at) => Some(at.duration_since(now).as_secs_f64()),
            _ => None,
        };
        assert_eq!(pause(0, 0.0), Some(5.0));
        assert_eq!(pause(0, 1.0), Some(6.0));
        assert_eq!(pause(6, 0.0), Some(50_400.0));
        assert_eq!(pause(7, 0.0), None);
    }

    #[test]
    fn the_retry_after_of_a_receiver_is_respected_up_to_a_maximum() {
        let (settings, now) = (defaults(), Timestamp::now());
        let pause = |seconds| {
            let retry_after = Some(Duration::from_secs(seconds));
            match settings.after_failure(0, retry_after, now, 0.0) {
                Disposition::RetryAt(at) => at.duration_since(now).as_secs(),
                _ => panic!("given up"),
            }
        };
        assert_eq!([pause(0), pause(2), pause(77)], [5, 5, 77]);
        assert_eq!(pause(u64::MAX) as u64, settings.retry_after_max_s);
    }

    #[test]
    fn an_invalid_setting_is_named_in_the_error() {
        let error = |change: fn(&mut WebhookSettings)| {
            let mut settings = defaults();
            change(&mut settings);
            settings.validate().unwrap()
        };
        assert_eq!(defaults().validate(), None);
        assert!(error(|settings| settings.max = 0).contains("webhooks.max "));
        assert!(error(|settings| settings.timeout_s = 0).contains("timeout_s"));
        assert!(error(|settings| settings.concurrency_each = 999).contains("concurrency_each"));
        assert!(error(|settings| settings.retry_s = vec![u64::MAX]).contains("retry_s"));
        assert!(error(|settings| settings.retry_after_max_s = u64::MAX).contains("retry_after"));
    }
}
