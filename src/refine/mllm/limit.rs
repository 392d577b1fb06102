//! How many calls at once a server bears, found out from what it turns away and from how long it takes.

use std::time::Duration;

/// The limit on calls at once, between 1 and a bound.
///
/// The scheme is TCP's congestion control (RFC 5681: slow start, then additive increase and multiplicative decrease,
/// at most one decrease for what was sent since the last one), which Chiu and Jain (1989) showed to converge to a fair
/// share, and which Netflix's `concurrency-limits` applies to requests. Three things differ, because calls to a model
/// are few and long:
///
/// - *Turned away* (429, 503, a reset connection): one such answer is noise, as rare spurious ones are, and would cost
///   a loss-driven scheme most of its limit. Two in a row, or three of the last 32, are overload. The limit then falls
///   to nine tenths, and further towards the number of calls that the server is still working on, which is what it
///   bears, by half at most.
/// - *Latency*: calls vary too much for a comparison of single ones. The median of a round of 16 calls of the same
///   purpose is compared with the lowest of such medians. If it is more than twice as long, the limit is halved on
///   trial, which is kept if it shortened the calls, and taken back if it did not: then the load was not the reason.
/// - The limit grows only while it is what holds calls back.
#[derive(Debug)]
pub(super) struct CallLimit {
    bound: usize,
    limit: f64,
    /// Slow start ends here.
    threshold: f64,
    /// How far the limit may fall until another call is sent and turned away: many calls that end together leave the
    /// server with few for a moment.
    floor: f64,
    /// Counts decreases. What was sent before the last one says nothing about the limit now.
    epoch: u32,
    /// Counts sent calls.
    sent: u64,
    /// The number of calls that were sent when the threshold was last lowered, and whether a later one was answered.
    /// Without one, the server takes nothing at the moment, which says nothing about where slow start is to end.
    lowered_at: u64,
    is_proven: bool,
    /// The last 32 outcomes, the newest in the lowest bit; set for a call that was turned away.
    outcomes: u32,
    /// By purpose.
    rounds: [Round; 2],
    trial: Option<Trial>,
}

/// What a call is for. Calls that rank take another time than those that describe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CallPurpose {
    Describe,
    Rank,
}

/// A call as the limit knows it.
#[derive(Debug, Clone, Copy)]
pub(super) struct SentCall {
    pub purpose: CallPurpose,
    epoch: u32,
    /// From 1.
    number: u64,
}

/// The durations of the last calls.
#[derive(Debug, Default)]
struct Round {
    took: Vec<Duration>,
    /// The lowest median of a round so far.
    usual: Option<Duration>,
}

/// A halved limit.
#[derive(Debug, Clone, Copy)]
struct Trial {
    purpose: CallPurpose,
    /// Before it was halved.
    limit: f64,
    median: Duration,
}

/// Where the limit starts, unless its bound is lower. What a server bears is not known then; a higher bound is reached
/// in a few rounds.
const START: usize = 64;

/// Calls whose median is compared.
const ROUND: usize = 16;

/// A round of additive increase has at least as many calls, so that a server that bears one or two at once is not tried
/// with more all the time.
const LEAST_ROUND: f64 = 8.0;

/// How much longer than usual calls may take.
const SLOW: f64 = 2.0;

/// A halved limit is kept if the calls take at most this share of the time that they took before.
const SHORTER: f64 = 0.7;

/// What is left of the limit where a server turns calls away.
const DECREASE: f64 = 0.9;

/// What is left of it at least.
const MOST_DECREASE: f64 = 0.5;

/// Calls of the last 32 that must have been turned away before the limit falls.
const SEVERAL: u32 = 3;

impl CallLimit {
    pub fn new(bound: usize) -> Self {
        let bound = bound.max(1);
        Self {
            bound,
            limit: bound.min(START) as f64,
            threshold: bound as f64,
            floor: 1.0,
            epoch: 0,
            sent: 0,
            lowered_at: 0,
            is_proven: false,
            outcomes: 0,
            rounds: Default::default(),
            trial: None,
        }
    }

    /// Returns the limit.
    pub fn get(&self) -> usize {
        // Positive and small.
        (self.limit as usize).clamp(1, self.bound)
    }

    /// Returns the bound.
    pub fn bound(&self) -> usize {
        self.bound
    }

    /// Lowers the bound to what a server says that it works on at once.
    pub fn bound_by(&mut self, slots: usize) {
        self.bound = self.bound.min(slots.max(1));
        self.set(self.limit);
    }

    /// Lowers the limit to what a check found out. It may grow again.
    pub fn start_from(&mut self, at_once: usize) {
        self.set(self.limit.min(at_once as f64));
        self.threshold = self.limit;
    }

    /// Notes that a call is sent.
    pub fn sent(&mut self, purpose: CallPurpose) -> SentCall {
        self.sent += 1;
        SentCall { purpose, epoch: self.epoch, number: self.sent }
    }

    /// Notes the end of a call that the server worked on. `is_full` is whether the limit held other calls back.
    pub fn answered(&mut self, call: SentCall, took: Duration, is_full: bool) {
        self.outcomes <<= 1;
        self.is_proven |= call.number > self.lowered_at;
        if is_full && self.trial.is_none() {
            let round = self.limit.max(LEAST_ROUND);
            let step = if self.limit < self.threshold { 1.0 } else { 1.0 / round };
            self.set(self.limit + step);
        }
        self.measured(call, took);
    }

    /// Notes a call that was not answered in time: all that is known of it is that it took so long.
    pub fn timed_out(&mut self, call: SentCall, took: Duration) {
        self.measured(call, took);
    }

    /// Returns how long calls take while the server is not busy, as far as it is known.
    pub fn usual(&self, purpose: CallPurpose) -> Option<Duration> {
        self.rounds[purpose as usize].usual
    }

    /// Notes a call that the server turned away, and how many of ours it works on at the moment.
    pub fn turned_away(&mut self, call: SentCall, working: usize) {
        self.outcomes = self.outcomes << 1 | 1;
        if self.outcomes & 0b11 != 0b11 && self.outcomes.count_ones() < SEVERAL {
            return;
        }
        self.outcomes &= 0b11;
        if call.epoch == self.epoch {
            let less = self.limit * DECREASE;
            if self.is_proven {
                self.threshold = less.floor().max(1.0);
                self.lowered_at = self.sent;
                self.is_proven = false;
            }
            self.floor = self.limit * MOST_DECREASE;
            self.decrease(less);
        }
        self.set(self.limit.min(working as f64).max(self.floor));
    }

    fn decrease(&mut self, to: f64) {
        self.trial = None;
        self.epoch = self.epoch.wrapping_add(1);
        self.rounds.iter_mut().for_each(|round| round.took.clear());
        self.set(to);
    }

    fn set(&mut self, limit: f64) {
        self.limit = limit.clamp(1.0, self.bound as f64);
    }

    fn measured(&mut self, call: SentCall, took: Duration) {
        if call.epoch != self.epoch {
            return;
        }
        let round = &mut self.rounds[call.purpose as usize];
        round.took.push(took);
        if round.took.len() < ROUND {
            return;
        }
        let mut took = std::mem::take(&mut round.took);
        took.sort_unstable();
        let median = took[ROUND / 2];
        match self.trial.take_if(|trial| trial.purpose == call.purpose) {
            Some(trial) => self.conclude(trial, median),
            None => self.compare(call.purpose, median),
        }
    }

    fn compare(&mut self, purpose: CallPurpose, median: Duration) {
        let usual = &mut self.rounds[purpose as usize].usual;
        let known = *usual.get_or_insert(median);
        if median <= known.mul_f64(SLOW) || self.trial.is_some() {
            *usual = Some(known.min(median));
        } else if self.get() > 1 {
            self.halve(purpose, median);
        }
    }

    fn halve(&mut self, purpose: CallPurpose, median: Duration) {
        let limit = self.limit;
        self.decrease(limit / 2.0);
        self.trial = Some(Trial { purpose, limit, median });
    }

    fn conclude(&mut self, trial: Trial, median: Duration) {
        if median <= trial.median.mul_f64(SHORTER) {
            self.threshold = self.limit;
        } else if median > trial.median.mul_f64(1.0 / SHORTER) && self.get() > 1 {
            // The server is still busy with what it got before.
            self.halve(trial.purpose, median);
        } else {
            self.set(trial.limit);
            self.rounds[trial.purpose as usize].usual = Some(trial.median.min(median));
        }
    }
}

#[cfg(test)]
mod tests;
