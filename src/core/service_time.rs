//! How fast work is done, measured as it ends.

use std::time::Duration;

/// A running mean over about the last ten pieces of work.
#[derive(Debug, Clone, Copy, Default)]
pub struct ServiceTime {
    /// Of one piece, in seconds, and between the ends of two.
    measured: Option<(f64, f64)>,
}

/// The weight of the latest piece.
const WEIGHT: f64 = 0.1;

impl ServiceTime {
    /// One piece took so long, while `side_by_side` were in progress, itself included.
    pub fn record(&mut self, took: Duration, side_by_side: usize) {
        let took = took.as_secs_f64();
        let between = took / side_by_side.max(1) as f64;
        let mean = |known: f64, new: f64| known + WEIGHT * (new - known);
        self.measured = Some(match self.measured {
            Some((one, interval)) => (mean(one, took), mean(interval, between)),
            None => (took, between),
        });
    }

    /// How long one piece takes; zero before any was measured.
    pub fn mean(&self) -> Duration {
        Duration::from_secs_f64(self.measured.map_or(0.0, |(one, _)| one))
    }

    /// How long it takes until `pieces` have ended; zero before any was measured.
    pub fn until_done(&self, pieces: usize) -> Duration {
        Duration::from_secs_f64(self.measured.map_or(0.0, |(_, interval)| interval * pieces as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_runs_side_by_side_ends_the_more_often() {
        let mut time = ServiceTime::default();
        assert_eq!(time.until_done(10), Duration::ZERO);
        time.record(Duration::from_secs(2), 4);
        assert_eq!(time.mean(), Duration::from_secs(2));
        assert_eq!(time.until_done(10), Duration::from_secs(5));
    }

    #[test]
    fn one_slow_piece_is_soon_forgotten() {
        let mut time = ServiceTime::default();
        time.record(Duration::from_secs(100), 1);
        (0..100).for_each(|_| time.record(Duration::from_millis(10), 1));
        assert!(time.mean() < Duration::from_millis(20), "{time:?}");
    }
}
