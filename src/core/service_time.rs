//! Service time of a queue, measured as requests complete.

use std::time::Duration;

/// An exponential moving average of the service time, over about the last ten requests.
#[derive(Debug, Clone, Copy, Default)]
pub struct ServiceTime {
    averages: Option<Averages>,
}

#[derive(Debug, Clone, Copy)]
struct Averages {
    /// Seconds that one request takes.
    service_s: f64,
    /// Seconds between two completions; shorter than the service time where requests run concurrently.
    interval_s: f64,
}

/// The weight of the newest sample.
const WEIGHT: f64 = 0.1;

impl ServiceTime {
    /// Records a completed request that took `elapsed` while `concurrency` requests, itself included,
    /// were in progress.
    pub fn record(&mut self, elapsed: Duration, concurrency: usize) {
        let service_s = elapsed.as_secs_f64();
        let interval_s = service_s / concurrency.max(1) as f64;
        let update = |average: f64, sample: f64| average + WEIGHT * (sample - average);
        self.averages = Some(match self.averages {
            Some(known) => Averages {
                service_s: update(known.service_s, service_s),
                interval_s: update(known.interval_s, interval_s),
            },
            None => Averages { service_s, interval_s },
        });
    }

    /// Average service time of one request; zero before the first sample.
    pub fn mean(&self) -> Duration {
        Duration::from_secs_f64(self.averages.map_or(0.0, |known| known.service_s))
    }

    /// Expected time until `requests` have completed; zero before the first sample.
    pub fn until_done(&self, requests: usize) -> Duration {
        let seconds = self.averages.map_or(0.0, |known| known.interval_s * requests as f64);
        Duration::from_secs_f64(seconds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn concurrency_shortens_the_time_until_a_queue_is_done() {
        let mut time = ServiceTime::default();
        assert_eq!(time.until_done(10), Duration::ZERO);
        time.record(Duration::from_secs(2), 4);
        assert_eq!(time.mean(), Duration::from_secs(2));
        assert_eq!(time.until_done(10), Duration::from_secs(5));
    }

    #[test]
    fn one_slow_request_fades_from_the_average() {
        let mut time = ServiceTime::default();
        time.record(Duration::from_secs(100), 1);
        (0..100).for_each(|_| time.record(Duration::from_millis(10), 1));
        assert!(time.mean() < Duration::from_millis(20), "{time:?}");
    }
}
