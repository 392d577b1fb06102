//! Bounds of webhooks, and when a delivery is tried again.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use serde::{Deserialize, Serialize};

use super::super::retention::before;
use whereabouts_core::Disposition;
use whereabouts_store::DeliveryRetention;

/// The most tries after the first, and the longest pause between two, in seconds.
const MOST_RETRIES: usize = 32;
const LONGEST_PAUSE_S: u64 = 7 * 24 * 3600;

/// The longest attempt, in seconds.
const LONGEST_ATTEMPT_S: u64 = 120;

/// A pause is longer than was configured by up to this share of it, so that what failed together is not
/// tried again together.
const JITTER: f64 = 0.2;

/// `[webhooks]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhookSettings {
    /// The most webhooks.
    pub max: usize,
    /// The longest attempt, in seconds.
    pub timeout_s: u64,
    /// Attempts in progress.
    pub concurrency: usize,
    /// Attempts in progress for one webhook.
    pub concurrency_each: usize,
    /// The pauses before the second and all further tries, in seconds.
    pub retry_s: Vec<u64>,
    /// The longest Retry-After that is waited for, in seconds.
    pub retry_after_max_s: u64,
    /// How long a delivery is kept after it has ended, in days; 0: for ever.
    pub keep_days: u32,
    /// The most deliveries that are kept.
    pub max_deliveries: usize,
    /// Whether messages may go to addresses that are not public.
    pub allow_private: bool,
}

impl WebhookSettings {
    /// What is wrong with them, if anything.
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
        if !(1..=LONGEST_ATTEMPT_S).contains(&self.timeout_s) {
            return Some(format!("webhooks.timeout_s must be 1 to {LONGEST_ATTEMPT_S}"));
        }
        if self.concurrency_each > self.concurrency {
            return Some("webhooks.concurrency_each must not exceed webhooks.concurrency".into());
        }
        let too_long = |seconds: &u64| *seconds > LONGEST_PAUSE_S;
        if self.retry_s.len() > MOST_RETRIES || self.retry_s.iter().any(too_long) {
            return Some(format!(
                "webhooks.retry_s must have at most {MOST_RETRIES} pauses of at most {LONGEST_PAUSE_S} \
                 seconds"
            ));
        }
        if too_long(&self.retry_after_max_s) {
            return Some(format!("webhooks.retry_after_max_s must be at most {LONGEST_PAUSE_S}"));
        }
        None
    }

    pub(super) fn timeout(&self) -> Duration {
        Duration::from_secs(self.timeout_s)
    }

    /// Which deliveries are kept at that moment.
    pub(super) fn keep(&self, now: Timestamp) -> DeliveryRetention {
        let age = Duration::from_secs(u64::from(self.keep_days) * 24 * 3600);
        let since = (!age.is_zero()).then(|| before(now, age));
        DeliveryRetention { since, most: self.max_deliveries }
    }

    /// What becomes of a delivery that failed after so many attempts before. `chance` is 0 to 1.
    pub(super) fn after_failure(
        &self,
        attempts: u32,
        retry_after: Option<Duration>,
        now: Timestamp,
        chance: f64,
    ) -> Disposition {
        let Some(pause) = self.retry_s.get(attempts as usize) else { return Disposition::Dead };
        let pause = Duration::from_secs(*pause).mul_f64(1.0 + JITTER * chance);
        let asked_for = retry_after.unwrap_or_default();
        let pause = pause.max(asked_for.min(Duration::from_secs(self.retry_after_max_s)));
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
    fn pauses_are_as_configured_with_some_jitter_and_then_there_is_an_end() {
        let (settings, now) = (defaults(), Timestamp::now());
        let pause = |attempts, chance| match settings.after_failure(attempts, None, now, chance) {
            Disposition::RetryAt(at) => Some(at.duration_since(now).as_secs_f64()),
            _ => None,
        };
        assert_eq!(pause(0, 0.0), Some(5.0));
        assert_eq!(pause(0, 1.0), Some(6.0));
        assert_eq!(pause(6, 0.0), Some(50_400.0));
        assert_eq!(pause(7, 0.0), None);
    }

    #[test]
    fn who_asks_for_patience_is_given_it_up_to_a_bound() {
        let (settings, now) = (defaults(), Timestamp::now());
        let pause = |seconds| {
            let asked_for = Some(Duration::from_secs(seconds));
            match settings.after_failure(0, asked_for, now, 0.0) {
                Disposition::RetryAt(at) => at.duration_since(now).as_secs(),
                _ => panic!("given up"),
            }
        };
        assert_eq!([pause(0), pause(2), pause(77)], [5, 5, 77]);
        assert_eq!(pause(u64::MAX) as u64, settings.retry_after_max_s);
    }

    #[test]
    fn settings_that_make_no_sense_are_named() {
        let wrong = |change: fn(&mut WebhookSettings)| {
            let mut settings = defaults();
            change(&mut settings);
            settings.validate().unwrap()
        };
        assert_eq!(defaults().validate(), None);
        assert!(wrong(|settings| settings.max = 0).contains("webhooks.max "));
        assert!(wrong(|settings| settings.timeout_s = 0).contains("timeout_s"));
        assert!(wrong(|settings| settings.concurrency_each = 999).contains("concurrency_each"));
        assert!(wrong(|settings| settings.retry_s = vec![u64::MAX]).contains("retry_s"));
        assert!(wrong(|settings| settings.retry_after_max_s = u64::MAX).contains("retry_after"));
    }
}
