//! The gate to one server: as many calls pass at once as it bears, those of the oldest job first.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use tokio::sync::{oneshot, watch};
use tokio::time::Instant;
use uuid::Uuid;
use whereabouts_core::Priority;

use super::limit::{CallLimit, CallPurpose, SentCall};
use super::retry::random_fraction;
use crate::sync::{Mutex, MutexGuard};

/// The place of a call among those that wait: by priority, then the oldest job first, because its id begins with the
/// time, then in the order of its pairs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct CallPlace(Reverse<Priority>, Uuid, usize);

impl CallPlace {
    pub fn new(priority: Priority, job: Uuid) -> Self {
        Self(Reverse(priority), job, 0)
    }

    /// Returns the place of the calls for one of the job's pairs.
    pub fn of_pair(self, index: usize) -> Self {
        Self(self.0, self.1, index)
    }
}

/// Lets calls pass, and knows whether there is room for another job.
#[derive(Debug)]
pub(super) struct CallGate {
    state: Mutex<State>,
    /// Whether the calls of the jobs in progress leave room for another job.
    room: watch::Sender<bool>,
    /// The pause after a server has turned away a call although it had no other; it doubles with each further one.
    pause: Duration,
}

#[derive(Debug)]
struct State {
    limit: CallLimit,
    /// Permits that are given out.
    permits: usize,
    /// Calls that are sent and not answered.
    sent: usize,
    /// Those of them that seem to hang. They do not count against the limit, but against its bound.
    late: usize,
    waiting: BTreeMap<(CallPlace, u64), oneshot::Sender<()>>,
    /// Counts arrivals, to keep those of the same place in order.
    arrivals: u64,
    /// Calls that the jobs in progress are still to make, or are making, as far as it is known.
    wanted: usize,
    /// No call passes before.
    held_until: Option<Instant>,
    /// Calls in a row that were turned away although they were the only ones.
    alone: u32,
}

/// What is going on at a gate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct GateLevels {
    /// Calls that are sent and not answered.
    pub sent: usize,
    /// Calls that may be in progress at once.
    pub limit: usize,
}

/// The longest doubled pause, and how often it doubles.
const LONGEST_PAUSE: Duration = Duration::from_secs(20);
const MOST_DOUBLINGS: u32 = 8;

/// One call in this many is kept ready beside those in progress: calls that were sent together often end together.
const AHEAD: usize = 2;

/// A call that takes this many times as long as usual seems to hang.
const LATE: u32 = 4;

impl CallGate {
    pub fn new(bound: usize, pause: Duration) -> Arc<Self> {
        let state = State {
            limit: CallLimit::new(bound),
            permits: 0,
            sent: 0,
            late: 0,
            waiting: BTreeMap::new(),
            arrivals: 0,
            wanted: 0,
            held_until: None,
            alone: 0,
        };
        Arc::new(Self { state: Mutex::new(state), room: watch::Sender::new(true), pause })
    }

    /// Puts a call into the queue. Dropping its turn gives up the place.
    pub fn queue(self: &Arc<Self>, place: CallPlace) -> Turn {
        let (turn, is_mine) = oneshot::channel();
        let mut state = self.state();
        state.arrivals += 1;
        let key = (place, state.arrivals);
        state.waiting.insert(key, turn);
        state.admit();
        Turn { gate: Arc::clone(self), place, key: Some(key), is_mine }
    }

    /// Waits for the turn of a call.
    pub async fn pass(self: &Arc<Self>, place: CallPlace) -> Permit {
        self.queue(place).passed().await
    }

    /// Counts calls that a job is to make, each until its guard is dropped.
    pub fn want(self: &Arc<Self>, calls: usize) -> Vec<WantedCall> {
        self.change(|state| state.wanted += calls);
        (0..calls).map(|_| WantedCall(Arc::clone(self))).collect()
    }

    /// Whether another job is needed to keep all permits busy.
    pub fn has_room(&self) -> bool {
        *self.room.borrow()
    }

    /// Returns once [`Self::has_room`].
    pub async fn room(&self) {
        // Cannot fail, because the sender lives as long as `self`.
        let _ = self.room.subscribe().wait_for(|has_room| *has_room).await;
    }

    pub fn levels(&self) -> GateLevels {
        let state = self.state();
        GateLevels { sent: state.sent, limit: state.limit.get() }
    }

    /// Changes the limit, as a check found out about it.
    pub fn adjust(&self, change: impl FnOnce(&mut CallLimit)) {
        self.change(|state| change(&mut state.limit));
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock()
    }

    /// Applies a change and lets pass whoever may pass after it.
    fn change<T>(&self, change: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.state();
        let changed = change(&mut state);
        state.admit();
        let has_room = state.has_room();
        self.room.send_if_modified(|room| std::mem::replace(room, has_room) != has_room);
        changed
    }

    /// Lets no call pass for a while.
    fn hold(self: &Arc<Self>, wait: Duration) {
        let until = Instant::now() + wait;
        let is_longer = self.change(|state| {
            let is_longer = state.held_until.is_none_or(|held| held < until);
            state.held_until = state.held_until.max(Some(until));
            is_longer
        });
        if is_longer {
            let gate: Weak<Self> = Arc::downgrade(self);
            tokio::spawn(async move {
                tokio::time::sleep_until(until).await;
                if let Some(gate) = gate.upgrade() {
                    gate.change(|_| ());
                }
            });
        }
    }
}

impl State {
    fn admit(&mut self) {
        if self.held_until.is_some_and(|held| held > Instant::now()) {
            return;
        }
        self.held_until = None;
        while !self.is_full() {
            let Some((_, turn)) = self.waiting.pop_first() else { return };
            self.permits += 1;
            // If the waiter has just left, it returns the permit itself.
            let _ = turn.send(());
        }
    }

    /// Whether the calls that are wanted do not suffice to keep all permits busy while another job is claimed and its
    /// pictures are prepared.
    fn has_room(&self) -> bool {
        let permits = (self.limit.get() + self.late).min(self.limit.bound());
        self.wanted <= permits + permits / AHEAD
    }

    fn is_full(&self) -> bool {
        let counted = self.permits - self.late;
        counted >= self.limit.get() || self.permits >= self.limit.bound()
    }

    fn ended(&mut self, sent: Sent) {
        self.sent -= 1;
        self.late -= usize::from(sent.is_late);
    }
}

/// A call that waits for its turn.
#[derive(Debug)]
pub(super) struct Turn {
    gate: Arc<CallGate>,
    place: CallPlace,
    /// `None` once it has its permit.
    key: Option<(CallPlace, u64)>,
    is_mine: oneshot::Receiver<()>,
}

impl Turn {
    /// Returns the place that was asked for.
    pub fn place(&self) -> CallPlace {
        self.place
    }

    /// Waits for it.
    pub async fn passed(mut self) -> Permit {
        // Cannot fail: the sender is kept until it has sent, or this is dropped.
        let _ = (&mut self.is_mine).await;
        self.key = None;
        Permit { gate: Arc::clone(&self.gate), sent: None }
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let Some(key) = self.key else { return };
        self.gate.change(|state| {
            if state.waiting.remove(&key).is_none() {
                state.permits -= 1;
            }
        });
    }
}

/// A call that a job is to make.
#[derive(Debug)]
pub(super) struct WantedCall(Arc<CallGate>);

impl Drop for WantedCall {
    fn drop(&mut self) {
        self.0.change(|state| state.wanted -= 1);
    }
}

/// The permission to make one call. Its outcome tells what the server bears; dropping it tells nothing.
#[derive(Debug)]
pub(super) struct Permit {
    gate: Arc<CallGate>,
    sent: Option<Sent>,
}

#[derive(Debug)]
struct Sent {
    call: SentCall,
    is_late: bool,
}

impl Permit {
    /// Reports that the call is sent now, and returns after what time it seems to hang, if that is known.
    pub fn sent(&mut self, purpose: CallPurpose) -> Option<Duration> {
        self.gate.clone().change(|state| {
            state.sent += 1;
            self.sent = Some(Sent { call: state.limit.sent(purpose), is_late: false });
            state.limit.usual(purpose).map(|usual| usual * LATE)
        })
    }

    /// Reports that the call seems to hang.
    pub fn is_late(&mut self) {
        let Some(sent) = self.sent.as_mut().filter(|sent| !sent.is_late) else { return };
        sent.is_late = true;
        self.gate.change(|state| state.late += 1);
    }

    /// Reports that the server worked on the call, whatever came of it.
    pub fn answered(mut self, took: Duration) {
        let Some(sent) = self.sent.take() else { return };
        self.gate.change(|state| {
            let is_full = state.is_full();
            let call = sent.call;
            state.ended(sent);
            state.alone = 0;
            state.limit.answered(call, took, is_full);
        });
    }

    /// Reports that the server did not answer in time.
    pub fn timed_out(mut self, took: Duration) {
        let Some(sent) = self.sent.take() else { return };
        self.gate.change(|state| {
            state.limit.timed_out(sent.call, took);
            state.ended(sent);
        });
    }

    /// Reports that the server turned the call away, and when it wants to be asked again. Returns whether it was
    /// working on others of ours. If it was not although it answers, it takes none at the moment, and all calls wait.
    pub fn turned_away(mut self, retry_after: Option<Duration>, answers: bool) -> bool {
        let Some(sent) = self.sent.take() else { return false };
        let (working, alone) = self.gate.change(|state| {
            let call = sent.call;
            state.ended(sent);
            let working = state.sent - state.late;
            state.limit.turned_away(call, working);
            state.alone += u32::from(working == 0);
            (working, state.alone)
        });
        if working == 0 && answers {
            let doubled = 2_u32.pow((alone - 1).min(MOST_DOUBLINGS));
            let pause = self.gate.pause.saturating_mul(doubled).min(LONGEST_PAUSE);
            let pause = pause.mul_f64(1.0 - random_fraction() / 2.0);
            self.gate.hold(pause.max(retry_after.unwrap_or_default()));
        }
        working > 0
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let sent = self.sent.take();
        self.gate.change(|state| {
            state.permits -= 1;
            if let Some(sent) = sent {
                state.ended(sent);
            }
        });
    }
}

#[cfg(test)]
mod schedules;

#[cfg(test)]
mod tests;
