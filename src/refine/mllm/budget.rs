//! Limits on spend, in tokens and in money, for one job and for one day of this process.
//!
//! The most that a call may cost is reserved before the call, and the reservation is settled by the bill.
//! Concurrent calls therefore cannot exceed a limit together.

use std::sync::Arc;

use jiff::Timestamp;
use jiff::civil::Date;
use parking_lot::{Mutex, MutexGuard};

use whereabouts_core::{Spent, utc_day};

/// Limits and prices; a limit of 0 stands for none.
#[derive(Debug, Clone, Copy, Default)]
pub struct SpendLimits {
    /// Tokens of one job.
    pub tokens_per_job: u64,
    /// Money for one job.
    pub money_per_job: f64,
    /// Tokens of one day.
    pub tokens_per_day: u64,
    /// Money for one day.
    pub money_per_day: f64,
    /// Money for a million tokens sent.
    pub price_prompt: f64,
    /// Money for a million tokens received.
    pub price_completion: f64,
}

/// The limit that a call would exceed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exceeded {
    /// That of its job.
    Job,
    /// That of the day.
    Day,
}

/// The budget of a process.
#[derive(Debug)]
pub struct Budget {
    limits: SpendLimits,
    today: Mutex<Today>,
}

#[derive(Debug, Clone, Copy)]
struct Today {
    date: Date,
    spent: Spent,
}

impl SpendLimits {
    /// Returns the cost of these tokens.
    pub fn cost(&self, prompt_tokens: u64, completion_tokens: u64) -> Spent {
        let money = prompt_tokens as f64 * self.price_prompt
            + completion_tokens as f64 * self.price_completion;
        Spent { tokens: prompt_tokens.saturating_add(completion_tokens), money: money / 1e6 }
    }
}

impl Budget {
    /// Creates a budget with nothing spent today.
    pub fn new(limits: SpendLimits) -> Self {
        Self { limits, today: Mutex::new(Today { date: Date::MIN, spent: Spent::default() }) }
    }

    /// Sets what was spent on the day (UTC) of `now` before this process started.
    pub fn seed(&self, now: Timestamp, spent: Spent) {
        self.today(now).spent = spent;
    }

    /// Returns what is spent on the day (UTC) of `now`, including reservations.
    pub fn spent(&self, now: Timestamp) -> Spent {
        self.today(now).spent
    }

    /// Returns the cost of these tokens.
    pub fn cost(&self, prompt_tokens: u64, completion_tokens: u64) -> Spent {
        self.limits.cost(prompt_tokens, completion_tokens)
    }

    /// Returns the budget of one job that has spent these tokens in earlier attempts.
    pub fn for_job(self: &Arc<Self>, prompt_tokens: u64, completion_tokens: u64) -> JobBudget {
        let spent = Mutex::new(self.cost(prompt_tokens, completion_tokens));
        JobBudget { budget: Arc::clone(self), spent }
    }

    /// Returns today's account, and starts a new one on a new day.
    fn today(&self, now: Timestamp) -> MutexGuard<'_, Today> {
        let date = utc_day(now);
        let mut today = self.today.lock();
        if date > today.date {
            *today = Today { date, spent: Spent::default() };
        }
        today
    }
}

/// The budget of one job.
#[derive(Debug)]
pub struct JobBudget {
    budget: Arc<Budget>,
    spent: Mutex<Spent>,
}

impl JobBudget {
    /// Reserves the most that a call may cost.
    pub fn reserve(
        &self,
        prompt_tokens: u64,
        completion_tokens: u64,
        now: Timestamp,
    ) -> Result<Reservation<'_>, Exceeded> {
        let limits = &self.budget.limits;
        let most = limits.cost(prompt_tokens, completion_tokens);
        let mut job = self.spent();
        let job_after = job.plus(most);
        if job_after.exceeds(limits.tokens_per_job, limits.money_per_job) {
            return Err(Exceeded::Job);
        }
        let mut today = self.budget.today(now);
        let today_after = today.spent.plus(most);
        if today_after.exceeds(limits.tokens_per_day, limits.money_per_day) {
            return Err(Exceeded::Day);
        }
        *job = job_after;
        today.spent = today_after;
        Ok(Reservation { job: self, date: today.date, reserved: most })
    }

    fn spent(&self) -> MutexGuard<'_, Spent> {
        self.spent.lock()
    }
}

/// The reserved cost of one call. Released if it is dropped unsettled, because the call was not answered.
#[derive(Debug)]
#[must_use = "dropping a reservation releases it"]
pub struct Reservation<'a> {
    job: &'a JobBudget,
    date: Date,
    reserved: Spent,
}

impl Reservation<'_> {
    /// Replaces the reservation by the actual cost.
    pub fn settle(mut self, prompt_tokens: u64, completion_tokens: u64) {
        let cost = self.job.budget.limits.cost(prompt_tokens, completion_tokens);
        self.replace(cost);
    }

    fn replace(&mut self, by: Spent) {
        let mut job = self.job.spent();
        *job = job.minus(self.reserved).plus(by);
        let mut today = self.job.budget.today.lock();
        // After midnight there is another account, in which nothing was reserved.
        let reserved = if today.date == self.date { self.reserved } else { Spent::default() };
        today.spent = today.spent.minus(reserved).plus(by);
        self.reserved = Spent::default();
    }
}

impl Drop for Reservation<'_> {
    fn drop(&mut self) {
        if self.reserved != Spent::default() {
            self.replace(Spent::default());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use jiff::SignedDuration;

    fn budget(limits: SpendLimits) -> Arc<Budget> {
        Arc::new(Budget::new(limits))
    }

    fn noon() -> Timestamp {
        "2026-05-01T12:00:00Z".parse().unwrap()
    }

    #[test]
    fn a_call_that_might_exceed_the_limit_of_its_job_is_refused() {
        let budget = budget(SpendLimits { tokens_per_job: 1000, ..SpendLimits::default() });
        let job = budget.for_job(0, 0);
        let first = job.reserve(200, 400, noon()).unwrap();
        assert_eq!(job.reserve(200, 400, noon()).unwrap_err(), Exceeded::Job);
        first.settle(200, 100);
        let second = job.reserve(200, 400, noon()).unwrap();
        drop(second);
        assert_eq!(budget.spent(noon()).tokens, 300);
        assert!(budget.for_job(0, 0).reserve(500, 500, noon()).is_ok());
    }

    #[test]
    fn spend_of_earlier_attempts_counts_against_the_limit_of_the_job() {
        let budget = budget(SpendLimits { tokens_per_job: 1000, ..SpendLimits::default() });
        assert_eq!(budget.for_job(500, 100).reserve(300, 101, noon()).unwrap_err(), Exceeded::Job);
        assert!(budget.for_job(500, 100).reserve(300, 100, noon()).is_ok());
    }

    #[test]
    fn money_is_computed_from_the_prices() {
        let limits = SpendLimits {
            price_prompt: 2.5,
            price_completion: 10.0,
            money_per_day: 0.02,
            ..SpendLimits::default()
        };
        let budget = budget(limits);
        let job = budget.for_job(0, 0);
        job.reserve(2000, 1000, noon()).unwrap().settle(2000, 1000);
        assert!((budget.spent(noon()).money - 0.015).abs() < 1e-12);
        assert_eq!(job.reserve(2000, 1000, noon()).unwrap_err(), Exceeded::Day);
    }

    #[test]
    fn a_new_day_starts_with_nothing_spent_or_reserved() {
        let budget = budget(SpendLimits { tokens_per_day: 100, ..SpendLimits::default() });
        budget.seed(noon(), Spent { tokens: 90, money: 0.0 });
        let job = budget.for_job(0, 0);
        assert_eq!(job.reserve(20, 0, noon()).unwrap_err(), Exceeded::Day);
        let tomorrow = noon() + SignedDuration::from_hours(12);
        let over_midnight = budget.for_job(0, 0);
        let reserved = over_midnight.reserve(10, 0, noon()).unwrap();
        let next = job.reserve(20, 0, tomorrow).unwrap();
        reserved.settle(10, 0);
        assert_eq!(budget.spent(tomorrow).tokens, 30);
        next.settle(20, 0);
    }
}
