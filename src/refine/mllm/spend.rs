//! Limits on spend: the most that a call may cost is reserved before it is made, in the budgets of this process
//! ([`Budget`]) and, if several processes share a store, among all of them ([`SharedReservation`]).

use std::sync::Arc;

use jiff::Timestamp;
use whereabouts_core::{CachedDescription, DayUsage, Digest, Spent, Usage, utc_day};
use whereabouts_store::SharedLimits;

use super::MllmRefiner;
use super::budget::{Budget, Exceeded, JobBudget, Reservation, SpendLimits};
use super::client::{Answer, Call, MllmClient};
use super::gate::Turn;
use super::reservation::SharedReservation;
use super::retry::CallError;
use super::run::RefineRun;
use crate::store_retry::retry_write;

/// Enforces the limits on spend.
pub(super) struct SpendControl {
    pub budget: Arc<Budget>,
    shared: Option<Arc<dyn SharedLimits>>,
    daily_limit: Spent,
}

/// The reserved cost of one call. Released if it is dropped unsettled, because the call was not answered.
struct SpendReservation<'a> {
    budget: &'a Budget,
    local: Reservation<'a>,
    /// `None` if there is one process or no daily limit.
    shared: Option<SharedReservation>,
}

impl SpendControl {
    pub fn new(limits: SpendLimits, shared: Option<Arc<dyn SharedLimits>>) -> Self {
        let daily_limit = Spent { tokens: limits.tokens_per_day, money: limits.money_per_day };
        Self { budget: Arc::new(Budget::new(limits)), shared, daily_limit }
    }

    /// Returns the limits of a day; 0 stands for none.
    pub fn daily_limit(&self) -> Spent {
        self.daily_limit
    }

    /// Reserves the cost of a call with these numbers of tokens, if no limit could be exceeded.
    async fn reserve<'a>(
        &'a self,
        job: &'a JobBudget,
        prompt_tokens: u64,
        completion_tokens: u64,
    ) -> Result<SpendReservation<'a>, CallError> {
        let now = Timestamp::now();
        let reserved = job.reserve(prompt_tokens, completion_tokens, now);
        let local = reserved.map_err(|exceeded| match exceeded {
            Exceeded::Job => CallError::JobSpent,
            Exceeded::Day => CallError::DaySpent,
        })?;
        let shared = match &self.shared {
            Some(shared) if self.daily_limit != Spent::default() => {
                let most = self.budget.cost(prompt_tokens, completion_tokens);
                let (shared, today) = (Arc::clone(shared), utc_day(now));
                let reserved =
                    SharedReservation::reserve(shared, today, most, self.daily_limit).await;
                let reserved = reserved.map_err(|error| CallError::Transient(error.to_string()))?;
                Some(reserved.ok_or(CallError::DaySpent)?)
            }
            _ => None,
        };
        Ok(SpendReservation { budget: &self.budget, local, shared })
    }
}

impl SpendReservation<'_> {
    /// Replaces the reservation by the actual cost.
    fn settle(self, prompt_tokens: u64, completion_tokens: u64) {
        self.local.settle(prompt_tokens, completion_tokens);
        if let Some(shared) = self.shared {
            shared.settle(self.budget.cost(prompt_tokens, completion_tokens));
        }
    }
}

/// Returns the cost of a call as jobs report it.
pub(super) fn cost_of(answer: &Answer) -> Usage {
    Usage {
        calls: 1,
        cached: 0,
        prompt_tokens: answer.prompt_tokens,
        completion_tokens: answer.completion_tokens,
        estimated: answer.estimated.into(),
    }
}

impl MllmRefiner {
    /// Makes a call when it is its turn, if the limits on spend allow the longest answer it may get.
    pub(super) async fn paid_call(
        &self,
        run: &RefineRun<'_>,
        client: &MllmClient,
        call: &Call<'_>,
    ) -> Result<Answer, CallError> {
        client.ready().await;
        let turn = client.gate().queue(run.place());
        self.paid_call_in_turn(run, client, call, turn).await
    }

    /// Makes a call whose turn was queued before.
    pub(super) async fn paid_call_in_turn(
        &self,
        run: &RefineRun<'_>,
        client: &MllmClient,
        call: &Call<'_>,
        turn: Turn,
    ) -> Result<Answer, CallError> {
        let place = turn.place();
        let permit = turn.passed().await;
        let max_tokens = call.max_tokens.into();
        let reserved = self.spend.reserve(&run.budget, call.prompt_tokens, max_tokens).await?;
        let answer = client.call(call, place, permit).await?;
        reserved.settle(answer.prompt_tokens, answer.completion_tokens);
        run.charge(cost_of(&answer));
        Ok(answer)
    }

    /// Records what was spent, and the description that was bought for it. Runs as its own task, so that
    /// a job cancelled at this moment does not lose them.
    pub(super) async fn record_spend(
        &self,
        run: &RefineRun<'_>,
        usage: Usage,
        bought: Option<(Digest, CachedDescription)>,
    ) {
        let (cache, accounts) = (Arc::clone(&self.cache), Arc::clone(&self.usage));
        let money = self.spend.budget.cost(usage.prompt_tokens, usage.completion_tokens).money;
        let date = utc_day(Timestamp::now());
        let spent = DayUsage { date, map: run.input.map.name.clone(), usage, money };
        let recording = tokio::spawn(async move {
            let description = async {
                if let Some((key, description)) = bought {
                    let keep = || cache.keep_description(key, description.clone());
                    retry_write("a description; it will be bought again", keep).await;
                }
            };
            let account = retry_write("what was spent", || accounts.add_usage(spent.clone()));
            tokio::join!(description, account)
        });
        if let Err(error) = recording.await {
            tracing::error!(%error, "what was bought could not be recorded");
        }
    }
}
