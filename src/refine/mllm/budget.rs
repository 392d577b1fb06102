//! What calls may cost, in tokens and in money, for one job and for one day.
//!
//! A call is admitted with the longest answer it may get, and settled with what it was billed, so
//! that calls in progress together cannot pass a limit.

use std::sync::Arc;

use jiff::Timestamp;
use jiff::civil::Date;
use parking_lot::{Mutex, MutexGuard};

use whereabouts_core::{Spent, utc_day};

/// The bounds; 0 stands for none.
#[derive(Debug, Clone, Copy, Default)]
pub struct Limits {
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

/// A limit that a call would pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exceeded {
    /// The job's own.
    Job,
    /// The day's.
    Day,
}

/// The budget of a process.
#[derive(Debug)]
pub struct Budget {
    limits: Limits,
    today: Mutex<Today>,
}

#[derive(Debug, Clone, Copy)]
struct Today {
    date: Date,
    spent: Spent,
}

impl Limits {
    /// What so many tokens cost.
    pub fn cost(&self, prompt_tokens: u64, completion_tokens: u64) -> Spent {
        let money = prompt_tokens as f64 * self.price_prompt
            + completion_tokens as f64 * self.price_completion;
        Spent { tokens: prompt_tokens + completion_tokens, money: money / 1e6 }
    }
}

impl Budget {
    /// A budget of which nothing is spent today.
    pub fn new(limits: Limits) -> Self {
        Self { limits, today: Mutex::new(Today { date: Date::MIN, spent: Spent::default() }) }
    }

    /// Says what was spent on the day (UTC) of `now` before this process began.
    pub fn seed(&self, now: Timestamp, spent: Spent) {
        self.today(now).spent = spent;
    }

    /// What is spent on the day (UTC) of `now`, calls in progress included.
    pub fn spent(&self, now: Timestamp) -> Spent {
        self.today(now).spent
    }

    /// What so many tokens cost.
    pub fn cost(&self, prompt_tokens: u64, completion_tokens: u64) -> Spent {
        self.limits.cost(prompt_tokens, completion_tokens)
    }

    /// The budget of one job, of which so many tokens are spent.
    pub fn for_job(self: &Arc<Self>, prompt_tokens: u64, completion_tokens: u64) -> JobBudget {
        let spent = Mutex::new(self.cost(prompt_tokens, completion_tokens));
        JobBudget { budget: Arc::clone(self), spent }
    }

    /// Today's account; a new day starts an empty one.
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
    /// Sets aside what a call may cost at the most.
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
        Ok(Reservation { job: self, date: today.date, held: most })
    }

    fn spent(&self) -> MutexGuard<'_, Spent> {
        self.spent.lock()
    }
}

/// What is set aside for one call. Dropped unsettled, it goes back: the call was not answered.
#[derive(Debug)]
#[must_use = "dropped at once, it sets nothing aside"]
pub struct Reservation<'a> {
    job: &'a JobBudget,
    date: Date,
    held: Spent,
}

impl Reservation<'_> {
    /// Replaces what was set aside by what the call cost.
    pub fn settle(mut self, prompt_tokens: u64, completion_tokens: u64) {
        let cost = self.job.budget.limits.cost(prompt_tokens, completion_tokens);
        self.replace(cost);
    }

    fn replace(&mut self, by: Spent) {
        let mut job = self.job.spent();
        *job = job.minus(self.held).plus(by);
        let mut today = self.job.budget.today.lock();
        // Since midnight the account is another one, and nothing is set aside there.
        let held = if today.date == self.date { self.held } else { Spent::default() };
        today.spent = today.spent.minus(held).plus(by);
        self.held = Spent::default();
    }
}

impl Drop for Reservation<'_> {
    fn drop(&mut self) {
        if self.held != Spent::default() {
            self.replace(Spent::default());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use jiff::SignedDuration;

    fn budget(limits: Limits) -> Arc<Budget> {
        Arc::new(Budget::new(limits))
    }

    fn noon() -> Timestamp {
        "2026-05-01T12:00:00Z".parse().unwrap()
    }

    #[test]
    fn a_call_that_might_pass_the_limit_of_its_job_is_not_made() {
        let budget = budget(Limits { tokens_per_job: 1000, ..Limits::default() });
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
    fn what_an_earlier_attempt_spent_is_spent() {
        let budget = budget(Limits { tokens_per_job: 1000, ..Limits::default() });
        assert_eq!(budget.for_job(500, 100).reserve(300, 101, noon()).unwrap_err(), Exceeded::Job);
        assert!(budget.for_job(500, 100).reserve(300, 100, noon()).is_ok());
    }

    #[test]
    fn money_follows_the_prices() {
        let limits = Limits {
            price_prompt: 2.5,
            price_completion: 10.0,
            money_per_day: 0.02,
            ..Limits::default()
        };
        let budget = budget(limits);
        let job = budget.for_job(0, 0);
        job.reserve(2000, 1000, noon()).unwrap().settle(2000, 1000);
        assert!((budget.spent(noon()).money - 0.015).abs() < 1e-12);
        assert_eq!(job.reserve(2000, 1000, noon()).unwrap_err(), Exceeded::Day);
    }

    #[test]
    fn a_new_day_starts_with_nothing_spent() {
        let budget = budget(Limits { tokens_per_day: 100, ..Limits::default() });
        budget.seed(noon(), Spent { tokens: 90, money: 0.0 });
        let job = budget.for_job(0, 0);
        assert_eq!(job.reserve(20, 0, noon()).unwrap_err(), Exceeded::Day);
        let tomorrow = noon() + SignedDuration::from_hours(12);
        let over_midnight = budget.for_job(0, 0);
        let held = over_midnight.reserve(10, 0, noon()).unwrap();
        let next = job.reserve(20, 0, tomorrow).unwrap();
        held.settle(10, 0);
        assert_eq!(budget.spent(tomorrow).tokens, 30);
        next.settle(20, 0);
    }
}
